"""Files in and out: images, camera raw, rig.toml, capture folders and map folders."""
