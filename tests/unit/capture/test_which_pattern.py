"""Which pattern of a set a photo shows."""
