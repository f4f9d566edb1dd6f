"""docs/reference-files.md says what the code does."""

import re
from pathlib import Path

import invrender.files
from invrender.files import images, raster
from invrender.files.images import PHOTOS

PAGE = (Path(__file__).parents[3] / "docs" / "reference-files.md").read_text(encoding="utf-8")


def test_the_page_lists_every_ending_and_no_other():
    (line,) = re.findall(r"Endings of a capture's photo: `([^`]*)`", PAGE)
    assert tuple(line.split()) == PHOTOS


def test_the_page_lists_every_code_and_no_other():
    code = "\n".join(p.read_text() for p in Path(invrender.files.__file__).parent.glob("*.py"))
    used = set(re.findall(r'"((?:photo|rig)-[a-z-]+)"', code))
    assert set(re.findall(r"[`/]((?:photo|rig)-[a-z-]+)", PAGE)) == used


def test_the_pages_numbers_are_the_codes():
    assert f"limited by memory, {raster.MAX_MEMORY / raster.GIGABYTE:.0f} GB" in PAGE
    assert f"more than {images.WHOLE_PIXELS / 1e6:.0f} megapixels" in PAGE
    assert f"square within {images.SQUARE:.0%}" in PAGE
