"""What a check finds in a photo is not looked for again, unless something has changed."""

import numpy as np
import pytest

from invrender.app import store, work
from invrender.app.kept import read_found, write_found


class Reached(Exception):
    """The maps would be made now."""


def test_lights_are_found_once(tmp_path, monkeypatch):
    store.prepare(tmp_path)
    id = store.create_example(tmp_path)
    folder = store.folder_of(tmp_path, id)
    tell = lambda message: None  # noqa: E731
    work.check(tell, str(folder), 1)
    first = store.kept(folder, 1)
    given, looked = [], []

    def reconstruct(found, **options):
        given.extend(found)
        raise Reached

    def find(capture, fix):
        looked.append(fix)
        return first

    monkeypatch.setattr("invrender.pipeline.reconstruct", reconstruct)
    monkeypatch.setattr(work, "find_corrected_lights", find)
    with pytest.raises(Reached):
        work.refine(tell, str(folder), 64, "flat")
    assert looked == [] and given[0].capture.name == "Example"
    np.testing.assert_array_equal(given[0].lights.environment, first.lights.environment)
    np.testing.assert_array_equal(given[0].capture.photo.image, first.capture.photo.image)
    # Nothing is lost on the way through a file.
    path = tmp_path / "kept" / "again"
    write_found(path, 1, first)
    again = read_found(path, 1)
    assert again.notices == first.notices and again.ball == first.ball
    assert again.capture.rig == first.capture.rig and again.lights.fit == first.lights.fit
    assert again.capture.unknown == first.capture.unknown
    assert read_found(path, 2) is None
    path.write_bytes(b"not such a file")
    with pytest.raises(ValueError, match="does not hold"):
        read_found(path, 1)
    path.unlink()

    store.update(folder, fixes={"1": {"turn": 2}})
    with pytest.raises(Reached):
        work.refine(tell, str(folder), 64, "flat")
    assert looked == [{"turn": 2}]
    store.update(folder, fixes={})
    assert store.kept(folder, 1) is not None
    (folder / "photos" / "1" / "rig.toml").touch()
    assert store.kept(folder, 1) is None
    # A program that begins takes nothing from one before it.
    store.prepare(tmp_path)
    assert list((tmp_path / "kept").iterdir()) == []


def test_what_is_kept_is_bounded_and_discarded(tmp_path):
    store.prepare(tmp_path)
    id = store.create_example(tmp_path)
    folder = store.folder_of(tmp_path, id)
    sources = store.sources(folder, 1)
    for number in range(1, store.MOST_KEPT + 4):
        store.keep(folder, number, sources, {"number": number})
    assert len(list((tmp_path / "kept").iterdir())) == store.MOST_KEPT
    store.discard(tmp_path, id)
    assert list((tmp_path / "kept").iterdir()) == []
