"""``report.html``: a run's pictures, maps, lights and numbers, and a live viewer, in one file.

The page loads nothing and sends nothing: its content security policy allows the images inside it
and its one script, by that script's hash. Every string from a file is escaped by the template.
"""

from __future__ import annotations

import base64
import hashlib
import io
from importlib import resources
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from PIL import Image

from invrender.colour import linear_to_srgb
from invrender.maps import Maps
from invrender.report.report import Report
from invrender.sampling import means_of_blocks
from invrender.sphere import irradiance
from invrender.types import Array

VIEWER_SIZE = 512  # pixels a side of the viewer's maps at most
PICTURE_SIZE = 640  # of the still pictures
SIGMA_TOP = 0.2  # the expected error that is drawn brightest
# Five colours of the map "inferno" (Smith and van der Walt, CC0).
INFERNO = ((0, 0, 4), (87, 16, 110), (188, 55, 84), (249, 142, 9), (252, 255, 164))
SLIDERS = (
    ("power", "Lamp", 0, 3, 0.05, ""),
    ("room", "Room", 0, 3, 0.05, ""),
    ("angle", "Turn room", -180, 180, 1, "°"),
    ("exposure", "Exposure", -4, 4, 0.1, " EV"),
)
TITLES = {
    "diffuse": ("Diffuse albedo", "k_d, as sRGB"),
    "specular": ("Specular albedo", "k_s, as sRGB"),
    "roughness": ("Roughness", "black is a mirror"),
    "normal": ("Normal", "red: right, green: up"),
}


def report_html(
    report: Report,
    maps: Maps,
    sigma: dict[str, Array],
    environment: Array,
    pattern: Array | None,
    photo: Array,
    picture: Array,
) -> str:
    """The page. sigma: of each encoded map, see `invrender.maps.Estimate`. environment:
    (H, 2H, 3) radiance; pattern: (h, w, 3) the screen's radiance as captured, None
    without one; photo, picture: (N, N, 3) radiance of the sample and of its re-rendering."""
    white = white_level(photo)
    photo, picture = (block_means(x, PICTURE_SIZE) for x in (photo, picture))
    encoded = Maps(**{k: block_means(v, PICTURE_SIZE) for k, v in vars(maps).items()}).encoded()
    pictures = [
        (_jpeg(linear_to_srgb(photo / white)), "Photo", "the sample, cropped"),
        (_jpeg(linear_to_srgb(picture / white)), "Re-rendering", "from the maps below"),
        (
            _jpeg(np.clip(0.5 + 5 * (picture - photo) / white, 0, 1)),
            "Difference",
            "grey: none; black and white: a tenth of the photo's white",
        ),
    ]
    shown = []
    for name, (title, text) in TITLES.items():
        image = encoded[name] if name in ("roughness", "normal") else linear_to_srgb(encoded[name])
        spread = block_means(sigma[name], PICTURE_SIZE)
        spread = np.sqrt(np.mean(spread**2, -1)) if spread.ndim == 3 else spread
        shown.append({
            "name": name, "title": title, "text": text, "uri": _jpeg(image),
            "sigma_uri": _jpeg(heat(spread / SIGMA_TOP)), "median": float(np.median(spread)),
        })  # fmt: skip
    sky = environment[: environment.shape[0] // 2]
    lights = [
        (
            _jpeg(linear_to_srgb(sky / _level(sky))),
            "Room",
            "all directions above the table, straight up along the top edge; filled in behind the "
            "screen",
        ),
    ]
    if pattern is not None:
        uri = _jpeg(linear_to_srgb(pattern / _level(pattern)))
        lights.append((uri, "Screen", "as seen from above"))
    script = _data("viewer.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(
        _data("report.html.j2")
    )
    total = sum(report.seconds.values())
    return page.render(
        report=report,
        css=_data("report.css"),
        script=script,
        script_hash=f"sha256-{digest}",
        data=viewer_data(maps, environment),
        tiles=_tiles(report, total),
        sliders=SLIDERS,
        pictures=pictures,
        maps=shown,
        lights=lights,
        scale_colours=", ".join(f"rgb{c}" for c in INFERNO),
        scale_top=SIGMA_TOP,
        convergence=_convergence(report),
        timings=[(k, v, v / max(report.seconds.values())) for k, v in report.seconds.items()],
        facts=_facts(report),
    )


def viewer_data(maps: Maps, environment: Array) -> dict[str, Any]:
    """What the viewer's script reads: maps as PNG, the room as half floats, the shaders.

    Albedos are 8-bit sRGB; slopes and roughness have 16 bits, in two images of bytes, since eight
    would show as facets in a polished metal.
    """
    diffuse, specular, normal, roughness = (
        block_means(x, VIEWER_SIZE)
        for x in (maps.diffuse, maps.specular, maps.normal, maps.roughness)
    )
    size = max(diffuse.shape[:2])
    slopes = normal[..., :2]
    words = np.concatenate([slopes * 32767 + 32768, roughness[..., None] * 65535], -1)
    words = np.clip(np.rint(words), 0, 65535).astype(np.uint16)
    textures = {
        "diffuse": to_bytes(linear_to_srgb(diffuse)),
        "specular": to_bytes(linear_to_srgb(specular)),
        "high": (words >> 8).astype(np.uint8), "low": (words & 255).astype(np.uint8),
    }  # fmt: skip
    return {
        "size": size,
        "textures": {k: _uri(v, "PNG", compress_level=4) for k, v in textures.items()},
        "room": room_data(environment),
        "shaders": {k: _data(f"{k}.glsl") for k in ("brdf", "filter", "shade")},
    }


def room_data(environment: Array) -> dict[str, Any] | None:
    """The room, scaled so that its irradiance on the table is π; None where it is dark."""
    level = float(irradiance(environment).mean()) / np.pi
    if not level > 0:
        return None
    height, width = environment.shape[:2]
    rgba = np.ones((height, width, 4), np.float16)
    rgba[..., :3] = np.clip(environment / level, 0, 6e4)
    mean = irradiance(environment) / level / np.pi
    return {
        "width": width, "height": height, "mean": [float(m) for m in mean],
        "half": base64.b64encode(rgba.astype("<f2").tobytes()).decode(),
    }  # fmt: skip


def _tiles(report: Report, total: float) -> list[tuple[str, str]]:
    before, after = report.photo_error["initial"], report.photo_error["refined"]
    tiles = [
        (f"{before:.3f} → {after:.3f}", "photo error, before and after"),
        (f"{total:.1f} s", "from photo to maps"),
    ]
    if "ball_confidence" in report.capture_fit:
        tiles.append((f"{report.capture_fit['ball_confidence']:.0%}", "sure of the ball"))
    if report.map_error is not None:
        error = report.map_error["refined"]["average"]
        tiles.append((f"{error:.3f}", "mean error against the truth"))
    return tiles


def _facts(report: Report) -> list[tuple[str, str]]:
    fit = report.capture_fit
    facts = [
        ("start", {"network": "the network's maps", "flat": "a flat sample"}[report.init]),
        ("converged", "yes" if report.converged else "no"),
    ]
    if any(fit["gain"]):
        facts.insert(0, ("screen's white", " / ".join(f"{g:.2f}" for g in fit["gain"])))
    if "screen_tilt" in fit:
        where = f"{fit['screen_tilt']:.1f}°, {1000 * fit['screen_shift']:.1f} mm"
        facts.insert(1, ("screen's tilt and shift", where))
    if "ball_centre" in fit:
        x, y = fit["ball_centre"]
        where = f"({x:.1f}, {y:.1f}), radius {fit['ball_radius']:.1f} pixels"
        facts.insert(0, ("ball in the photo", where))
    if "residual" in fit:
        facts.insert(1, ("pattern misfit in the ball", f"{fit['residual']:.1%}"))
    return facts


def _convergence(report: Report) -> Markup:
    """Error against seconds as an SVG, the error's axis logarithmic."""
    points = [(0.0, report.photo_error["initial"])]
    points += [(h["seconds"], h["photo_error"]) for h in report.history]
    points += [(max(report.seconds["refine"], points[-1][0]), report.photo_error["refined"])]
    x, y = np.array(points).T
    y = np.log10(np.maximum(y, 1e-9))
    left, right, top, bottom = 40, 310, 8, 150
    low, high = np.floor(y.min() * 4) / 4, np.ceil(y.max() * 4) / 4
    high = max(high, low + 0.25)
    end = max(float(x.max()), 1e-3)
    u = left + x / end * (right - left)
    v = bottom - (y - low) / (high - low) * (bottom - top)
    parts = [
        '<svg viewBox="0 0 330 195" role="img" aria-label="photo error against seconds">',
        f'<path class="axis" fill="none" d="M{left} {top}V{bottom}H{right}"/>',
    ]
    for value in np.linspace(low, high, 3):
        at = bottom - (value - low) / (high - low) * (bottom - top)
        parts.append(f'<path class="axis" d="M{left} {at:.1f}H{right}"/>')
        text = f"{10**value:.2g}"
        parts.append(f'<text x="{left - 8}" y="{at + 4:.1f}" text-anchor="end">{text}</text>')
    for value in np.linspace(0, end, 3):
        at = left + value / end * (right - left)
        text = f"{value:.2g} s"
        parts.append(f'<text x="{at:.1f}" y="{bottom + 20}" text-anchor="middle">{text}</text>')
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(u, v, strict=True))
    parts.append(f'<polyline class="curve" points="{line}"/>')
    dots = zip(u, v, strict=True)
    parts += [f'<circle class="dot" cx="{a:.1f}" cy="{b:.1f}" r="3.5"/>' for a, b in dots]
    parts.append(
        f'<text x="{(left + right) / 2}" y="{bottom + 40}" text-anchor="middle">'
        "photo error against seconds of refinement</text></svg>"
    )
    return Markup("".join(parts))  # numbers and our own words only


def white_level(photo: Array) -> float:
    """The radiance of a sample's photo that is drawn white."""
    return max(float(np.percentile(block_means(photo, PICTURE_SIZE), 99.5)), 1e-12)


def _level(radiance: Array) -> float:
    """The radiance that is drawn white: most of the picture is below it, lamps may be above."""
    return max(float(np.percentile(radiance, 98)), 1e-12)


def heat(x: Array) -> Array:
    """Values in [0, 1] as colours (..., 3)."""
    at = np.linspace(0, 1, len(INFERNO))
    table = np.array(INFERNO) / 255
    return np.stack([np.interp(x, at, table[:, c]) for c in range(3)], -1)


def block_means(image: Array, largest: int) -> Array:
    """Mean over blocks, so that no side is longer than ``largest``."""
    step = -(-max(image.shape[:2]) // largest)
    if step == 1:
        return image
    return means_of_blocks(image, step, np.float32)


def to_bytes(image: Array) -> NDArray[np.uint8]:
    return np.asarray(np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def _jpeg(image: Array) -> str:
    """Display values (H, W) or (H, W, 3) in [0, 1] as a data URI."""
    data = to_bytes(block_means(image, PICTURE_SIZE))
    return _uri(data, "JPEG", quality=92, subsampling=0)


def _uri(data: NDArray[np.uint8], format: str, **options: Any) -> str:
    out = io.BytesIO()
    Image.fromarray(data).save(out, format, **options)
    return f"data:image/{format.lower()};base64," + base64.b64encode(out.getvalue()).decode()


def _data(name: str) -> str:
    return (resources.files("invrender") / "report" / "templates" / name).read_text(
        encoding="utf-8"
    )
