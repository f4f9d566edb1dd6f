"""Material folders as people have them, read into `Maps`.

A file's role is the last word of its name (resolution and format words aside), so these are known:
our own four EXR files; ``basecolor normal roughness [metallic]``; ambientCG's ``*_Color
*_NormalGL *_NormalDX *_Roughness *_Metalness``; Poly Haven's ``*_diff_1k *_nor_gl_1k *_rough_1k
*_metal_1k`` or ``*_arm_1k``; MatSynth's ``basecolor diffuse specular normal roughness metallic``;
``diffuse specular roughness|glossiness normal``; Poliigon's ``*_COL_2K_METALNESS``; Unreal's
``T_*_BC T_*_N T_*_ORM``; Unity's
``*_Albedo *_SpecularSmoothness *_Normal``, whose albedo counts 1 - max(k_s) times; one letter,
``*_d *_n *_r``; and the same in CamelCase.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from invrender.data.materials.augment import check_maps
from invrender.files.images import read_alpha, read_image
from invrender.files.maps import read_maps
from invrender.maps import NAMES, Maps, resize_maps
from invrender.sampling import resize
from invrender.types import Array, InputError

log = logging.getLogger("invrender")

DECISIVE = 0.35  # of `handedness`, from which the slopes tell
SUFFIXES = (".exr", ".png", ".tif", ".tiff", ".jpg", ".jpeg")  # the best first

_ROLES = {
    "basecolor": "basecolor basecolour albedo color colour col base bc basemap diffusecolor alb",
    "diffuse": "diffuse diff dif",
    "specular": "specular spec speccolor specularcolor reflectance reflection refl",
    "normal": "normal normals nor nrm norm normalgl normaldx normalogl nm normalmap",
    "roughness": "roughness rough rgh",
    "gloss": "gloss glossiness smoothness",
    "metallic": "metallic metalness metal met metallness mtl",
    "arm": "arm orm",
    "specular_gloss": "specularsmoothness specularglossiness",  # smoothness in the alpha channel
}
_ROLE = {word: role for role, words in _ROLES.items() for word in words.split()}
# One letter after a material's name; an explicit word is preferred.
_LETTER = {"d": "diffuse", "c": "basecolor", "n": "normal", "r": "roughness", "m": "metallic",
           "g": "gloss"}  # fmt: skip
_GL = {"gl", "opengl", "ogl", "normalgl", "normalogl"}
_DX = {"dx", "directx", "normaldx"}
_IGNORED = re.compile(r"\d+k|\d+x\d+|jpe?g|png|exr|tiff?|\d+bit|map|tex|texture|var\d+|\d+")
_NOT_BASE = {"emission", "emissive", "subsurface", "sheen", "coat", "mask", "id", "scatter"}
_UNREAL = re.compile(r"t_.+_n", re.IGNORECASE)  # Unreal's own names; its normals are DirectX


def _words(path: Path) -> list[str]:
    """The name's words in lower case, without those of resolution, format and workflow."""
    text = re.sub(r"(?i)open_?gl", "_opengl_", path.stem)
    text = re.sub(r"(?i)direct_?x", "_directx_", text)
    if not _ROLE.get(re.split(r"[\s_\-.]+", text.lower())[-1]):
        # WoodBaseColor; a word such as NormalGL stays one.
        text = re.sub(r"(?<=[a-z0-9])(?=[A-Z][a-z])", "_", text)
    words = [w for w in re.split(r"[\s_\-.]+", text.lower()) if w] or [""]
    # Poliigon: NAME_COL_2K_METALNESS, NAME_REFL_2K_SPECULAR.
    if len(words) > 2 and words[-1] in ("metalness", "specular") and words[-2].endswith("k"):
        words.pop()
    while len(words) > 1 and _IGNORED.fullmatch(words[-1]):
        words.pop()
    return words


def _role(path: Path) -> tuple[str, str, bool]:
    """(role of a file or "", "gl", "dx" or "" where a normal map's name is silent, one letter)."""
    words = _words(path)
    if words[0] == "sigma":  # a result's expected error of that map
        return "", "", False
    handed = ""
    if words[-1] in _GL | _DX:
        handed = "gl" if words[-1] in _GL else "dx"
        words = words[:-1] if len(words) > 1 and words[-1] not in _ROLE else words
    role = _ROLE.get(words[-1], "")
    before = words[-2] if len(words) > 1 else ""
    if role == "basecolor" and words[-1] in ("color", "colour", "col"):
        if before in _NOT_BASE:
            return "", "", False
        role = {"diffuse": "diffuse", "specular": "specular"}.get(before, role)
    if role == "gloss" and before == "specular":
        role = "specular_gloss"
    letter = not role and len(words) > 1 and words[-1] in _LETTER
    if letter:
        role = _LETTER[words[-1]]
    if handed and role not in ("normal",):
        return "", "", False
    return role, handed, letter


def material_files(folder: Path) -> dict[str, Path]:
    """The files of a folder by role; of several for one role the best: OpenGL, EXR, PNG first."""
    found: dict[str, tuple[tuple[bool, int, int, str], Path]] = {}
    for path in sorted(Path(folder).iterdir()):
        if path.suffix.lower() not in SUFFIXES or not path.is_file():
            continue
        role, handed, letter = _role(path)
        if not role:
            continue
        rank = (
            letter,
            {"gl": 0, "": 1, "dx": 2}[handed],
            SUFFIXES.index(path.suffix.lower()),
            path.name,
        )
        if role not in found or rank < found[role][0]:
            found[role] = rank, path
    return {role: path for role, (_, path) in found.items()}


def _is_ours(folder: Path) -> bool:
    return all((folder / f"{n}.exr").is_file() for n in NAMES)


def find_materials(root: Path) -> list[Path]:
    """All folders at or below ``root`` that hold a colour and a normal map, sorted.

    Raises `InputError` when the folder is missing or holds none.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root} is not a folder")
    found = []
    for folder in sorted({root, *(p for p in root.rglob("*") if p.is_dir())}):
        files = material_files(folder)
        if "normal" in files and files.keys() & {"basecolor", "diffuse"}:
            found.append(folder)
    if not found:
        raise InputError(f"{root} holds no material folders (a colour and a normal map in each)")
    return found


def read_material(folder: Path, max_size: int = 4096) -> Maps:
    """Read a material folder of any known layout; see the module's docstring.

    Base colour, diffuse and specular colours in PNG and JPEG are sRGB, all else linear. k_d =
    base·(1 - metallic), k_s = 0.04·(1 - metallic) + base·metallic. Where a base colour exists,
    diffuse and specular files beside it are not used. DirectX normals (named so, or shown by
    which way up they are the slopes of a surface) are turned into OpenGL; files of other sizes are
    resized to the colour's; anything longer than ``max_size`` pixels is averaged down. Each
    conversion is logged to "invrender". Raises `InputError` for missing, corrupt or degenerate
    files.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder")
    if _is_ours(folder):
        maps = read_maps(folder)
        h, w = maps.shape
        scale = max(h, w) / max_size
        return resize_maps(maps, round(h / scale), round(w / scale)) if scale > 1 else maps
    files = material_files(folder)
    missing = [n for n in NAMES if n not in files]
    if missing and (folder / "report.json").is_file():
        raise InputError(f"{folder} is a result without its {missing[0]} map: refine again")
    for role, alternatives in (
        ("colour", ("basecolor", "diffuse")),
        ("normal", ("normal",)),
        ("roughness", ("roughness", "gloss", "arm", "specular_gloss")),
    ):
        if not files.keys() & set(alternatives):
            raise InputError(f"{folder} has no {role} map")

    size: tuple[int, int] | None = None

    def load(role: str, linear: bool) -> Array:
        nonlocal size
        image = read_image(files[role], linear=linear)
        h, w = image.shape[:2]
        scale = max(h, w) / max_size
        if size is None:
            size = (round(h / scale), round(w / scale)) if scale > 1 else (h, w)
            if scale > 1:
                log.info("%s: %d × %d pixels, averaged down", files[role], w, h)
        elif (h, w) != size and scale <= 1:
            log.info("%s: resized from %d × %d to %d × %d", files[role], w, h, size[1], size[0])
        return resize(image, *size)

    unity = "specular_gloss" in files and not files.keys() & {"metallic", "arm"}
    workflow = "basecolor" not in files and "specular" in files and "metallic" not in files
    colour = np.clip(load("basecolor" if "basecolor" in files else "diffuse", False), 0, 1)
    if unity:
        specular = np.clip(load("specular_gloss", False), 0, 1)
        diffuse = colour * (1 - specular.max(-1, keepdims=True))
    elif workflow:
        diffuse, specular = colour, np.clip(load("specular", False), 0, 1)
    else:
        if "metallic" in files:
            metallic = load("metallic", True).mean(-1, keepdims=True)
        elif "arm" in files:
            metallic = load("arm", True)[..., 2:]
        else:
            metallic = np.zeros((*colour.shape[:2], 1), np.float32)
        metallic = np.clip(metallic, 0, 1)
        diffuse, specular = colour * (1 - metallic), 0.04 * (1 - metallic) + colour * metallic
    if "roughness" in files:
        rough = load("roughness", True).mean(-1)
    elif "gloss" in files:
        rough = 1 - load("gloss", True).mean(-1)
    elif unity:
        rough = 1 - resize(read_alpha(files["specular_gloss"]), *colour.shape[:2])
    else:
        rough = load("arm", True)[..., 1]
    normal = decode_normals(load("normal", True), files["normal"])
    handed = _role(files["normal"])[1]
    if not handed and _UNREAL.fullmatch(files["normal"].stem):
        handed = "gl" if handedness(normal) > DECISIVE else "dx"
    if handed == "dx" or (not handed and is_directx(normal)):
        why = "by its name" if handed else "as its slopes show"
        log.info("%s is a DirectX normal map (%s); turned into OpenGL", files["normal"], why)
        normal = normal * np.array([1, -1, 1], np.float32)
    return Maps(
        diffuse.astype(np.float32),
        specular.astype(np.float32),
        np.clip(rough, 0, 1).astype(np.float32),
        normal,
    )


def decode_normals(image: Array, path: Path) -> Array:
    """Unit normals (H, W, 3) from an image in [0, 1]; z is computed where only x, y are stored.

    Raises `InputError` for an image that cannot be a tangent-space normal map.
    """
    n = image * 2 - 1
    if image[..., 2].max() < 0.02:
        n[..., 2] = np.sqrt(np.clip(1 - n[..., 0] ** 2 - n[..., 1] ** 2, 1e-4, 1))
    if not 0.3 < float(np.median(n[..., 2])) < 1.5 or np.abs(n[..., :2]).mean() > 0.75:
        raise InputError(f"{path} does not look like a tangent-space normal map")
    n[..., 2] = np.maximum(n[..., 2], 0.02)
    return (n / np.linalg.norm(n, axis=-1, keepdims=True)).astype(np.float32)


def handedness(normal: Array) -> float:
    """How clearly normals are OpenGL (towards 1) or DirectX (towards -1); 0 is unknown.

    The slopes of a surface have no curl; with the wrong sign of y they do. Per scale this compares
    the mean squared curl of both readings, (b - a) / (b + a) with a as OpenGL, b as DirectX. Weaves
    drawn thread by thread are not the slopes of any surface and fool single scales, so the scales
    (1, 1/2 and 1/4 of the resolution) must agree, and the weakest counts.
    """
    scores: list[float] = []
    while min(normal.shape[:2]) >= 16 and len(scores) < 3:
        normal = resize(normal, normal.shape[0] // 2, normal.shape[1] // 2)
        slope = normal[..., :2].astype(np.float64) / np.maximum(normal[..., 2:], 0.15)
        # Slopes are -dh/dx and -dh/dy, and rows run against y: as OpenGL a + b is the curl.
        a = np.gradient(slope[..., 0], axis=0)
        b = np.gradient(slope[..., 1], axis=1)
        energy = float((a * a + b * b).mean())
        # Below: flat, or nothing but rounding.
        scores.append(float(-2 * (a * b).mean()) / energy if energy > 1e-7 else 0.0)
    if not scores or min(scores) < 0 < max(scores):
        return 0.0
    return min(scores, key=abs)


def is_directx(normal: Array) -> bool:
    """True only where the curl test is decisive, see `handedness`."""
    return handedness(normal) < -DECISIVE


def load_materials(
    root: Path, max_size: int = 4096, wanted: Callable[[Path], bool] = lambda folder: True
) -> Iterator[tuple[Path, Maps]]:
    """Every usable material below a folder whose own folder is ``wanted``, with its path.

    Broken, degenerate and unreadable ones are left out, each with one line in the log.
    """
    for folder in filter(wanted, find_materials(root)):
        try:
            maps = read_material(folder, max_size)
            check_maps(maps)
        except InputError as e:
            log.warning("%s left out: %s", folder, e)
        except (OSError, MemoryError) as e:
            log.warning("%s left out: %s", folder, e or type(e).__name__)
        else:
            yield folder, maps
