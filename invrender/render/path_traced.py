"""The same rig as a Mitsuba 3 scene: the whole photograph, reference images and the baseline.

Mitsuba's path tracer sees what the estimators leave out: the ball, the table and the light that
they and the sample exchange. The sample's BSDF is a plugin that calls `invrender.render.brdf`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from invrender.lights import IDEAL, Device, Lamp, Lights
from invrender.maps import Maps
from invrender.render import brdf
from invrender.render.backend import BACKEND, dr
from invrender.rig import Rig, fov_of
from invrender.sphere import mitsuba_rows, solid_angles
from invrender.types import Array, Vec3

import mitsuba as mi  # isort: skip  (after the back end has chosen its LLVM)

mi.set_variant(f"{BACKEND}_ad_rgb")
mi.set_log_level(mi.LogLevel.Error)  # it warns of sample counts that it rounds

# Of the screen's size: the table lies so far below the sample, the bezel so far above the lit area.
SAMPLE_LIFT = 1e-4
UP = np.array([0, 0, 1], np.float32)
# With a lamp: of the spp, the samples of the ball's window, which reaches so many of its radii.
LAMP_FACTOR, BALL_WINDOW = 16, 1.3
# Samples of an image at once, some seconds of two processors; and how far the next ones' seed is.
AT_ONCE, SEED_STEP = 80e6, 100_003


class CookTorrance(mi.BSDF):
    """`invrender.render.brdf` with per-pixel parameters: nearest texel, row 0 at v = 1.

    Parameters: diffuse, specular, normal (H, W, 3), roughness (H, W, 1), as tensors. Reflects
    nothing when either direction is below the surface or below the shading normal's horizon.
    """

    def __init__(self, props: mi.Properties) -> None:
        mi.BSDF.__init__(self, props)
        self.maps = {
            name: mi.TensorXf(props[name])
            for name in ("diffuse", "specular", "roughness", "normal")
        }
        self.m_components = [mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide]
        self.m_flags = self.m_components[0]

    def traverse(self, cb: mi.TraversalCallback) -> None:
        for name, tensor in self.maps.items():
            cb.put(name, tensor, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        pass

    def _fetch(self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Any:
        tensor = self.maps[name]
        h, w, channels = tensor.shape
        column = mi.UInt32(dr.clip(si.uv.x * w, 0, w - 1))
        row = mi.UInt32(dr.clip((1 - si.uv.y) * h, 0, h - 1))
        vector = mi.Float if channels == 1 else mi.Color3f
        return dr.gather(vector, tensor.array, row * w + column, active)

    def _setup(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[Any, Any, Any, Any]:
        n = dr.normalize(mi.Vector3f(self._fetch("normal", si, active)))
        s, t = brdf.frame(n)
        v = brdf.to_viewer(si.wi, s, t, n)
        alpha = dr.square(self._fetch("roughness", si, active))
        return s, t, v, alpha

    def _eval(
        self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        active &= (si.wi.z > 0) & (wo.z > 0)
        s, t, v, alpha = self._setup(si, active)
        l = brdf.to_local(wo, s, t, dr.cross(s, t))
        value, fresnel = brdf.specular(l, v, alpha)
        k_d, k_s = self._fetch("diffuse", si, active), self._fetch("specular", si, active)
        lobe = value * (k_s + (1 - k_s) * fresnel)
        color = k_d * (dr.maximum(l.z, 0) / dr.pi) + lobe
        pdf = 0.5 * (dr.maximum(l.z, 0) / dr.pi + brdf.pdf_vndf(l, v, alpha))
        return color & active, dr.select(active, pdf, 0)

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.BSDFSample3f, mi.Color3f]:
        s, t, v, alpha = self._setup(si, active)
        h = brdf.sample_vndf(v, alpha, sample2.x, sample2.y)
        mirror = dr.fma(h, 2 * dr.dot(v, h), -v)
        cosine = brdf.sample_cosine(sample2.x, sample2.y, mi.Vector3f)
        l = dr.select(sample1 < 0.5, mirror, cosine)
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo = dr.detach(brdf.to_world(l, s, t, dr.cross(s, t)))
        value, pdf = self._eval(si, bs.wo, mi.Bool(active))
        bs.pdf = dr.detach(pdf)
        bs.eta = 1
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        bs.sampled_component = 0
        valid = bs.pdf > 0
        return bs, dr.select(valid, value / dr.select(valid, bs.pdf, 1), 0)

    def eval(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool = True,
    ) -> mi.Color3f:
        return self._eval(si, wo, mi.Bool(active))[0]

    def pdf(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool = True,
    ) -> mi.Float:
        return self._eval(si, wo, mi.Bool(active))[1]

    def eval_pdf(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool = True,
    ) -> tuple[mi.Color3f, mi.Float]:
        return self._eval(si, wo, mi.Bool(active))

    def to_string(self) -> str:
        return "CookTorrance[]"


mi.register_bsdf("invrender", lambda props: CookTorrance(props))


class DimmingScreen(mi.Emitter):
    """A rectangle's light that dims to the sides: radiance(u, v) · cos(θ)^falloff.

    Parameters: radiance, a texture; corner, edge_x, edge_y of the rectangle, whose image has row 0
    at +edge_y; falloff.
    """

    def __init__(self, props: mi.Properties) -> None:
        mi.Emitter.__init__(self, props)
        self.radiance = props["radiance"]
        vector = lambda name: mi.Vector3f(mi.ScalarVector3f(props[name]))  # noqa: E731
        self.corner, self.e_x, self.e_y = (vector(k) for k in ("corner", "edge_x", "edge_y"))
        across = dr.cross(self.e_y, self.e_x)
        self.area = dr.norm(across)
        self.down = across / self.area
        self.falloff = mi.Float(props["falloff"])
        self.m_flags = mi.EmitterFlags.Surface | mi.EmitterFlags.SpatiallyVarying
        self.m_needs_sample_2 = True

    def _light(self, si: mi.SurfaceInteraction3f, cos: mi.Float, active: mi.Bool) -> mi.Color3f:
        active &= cos > 0
        dims = dr.maximum(cos, 0) ** self.falloff
        return dr.select(active, self.radiance.eval(si, active) * dims, 0)

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Color3f:
        return self._light(si, si.wi.z, mi.Bool(active))

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Color3f]:
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p = mi.Point3f(self.corner + sample.x * self.e_x + sample.y * self.e_y)
        ds.n = mi.Normal3f(self.down)
        ds.uv = mi.Point2f(sample.x, 1 - sample.y)
        ds.time = it.time
        ds.d = ds.p - it.p
        ds.dist = dr.norm(ds.d)
        ds.d /= ds.dist
        ds.emitter = mi.EmitterPtr(self)
        active = mi.Bool(active) & (dr.dot(ds.d, ds.n) < 0)
        ds.pdf = self.pdf_direction(it, ds, active)
        value = self.eval_direction(it, ds, active)
        return ds, dr.select(ds.pdf > 0, value / dr.select(ds.pdf > 0, ds.pdf, 1), 0)

    def pdf_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True
    ) -> mi.Float:
        cos = -dr.dot(ds.d, ds.n)
        ahead = mi.Bool(active) & (cos > 0)
        return dr.select(ahead, ds.dist * ds.dist / (dr.select(ahead, cos, 1) * self.area), 0)

    def eval_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True
    ) -> mi.Color3f:
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.uv = ds.uv
        return self._light(si, -dr.dot(ds.d, ds.n), mi.Bool(active))

    def bbox(self) -> mi.ScalarBoundingBox3f:
        return mi.ScalarBoundingBox3f()

    def to_string(self) -> str:
        return "DimmingScreen[]"


mi.register_emitter("dimming_screen", lambda props: DimmingScreen(props))


def _transform(columns: list[Array]) -> Any:
    matrix = np.eye(4)
    matrix[:3, :4] = np.stack(columns, -1)
    return mi.ScalarTransform4f(matrix)


def _bitmap(image: Array) -> Any:
    return mi.Bitmap(np.ascontiguousarray(image, dtype=np.float32))


def sample_scene(
    rig: Rig,
    maps: Maps,
    pattern: Array | None,
    environment: Array | None,
    gain: Any = 1.0,
    *,
    max_depth: int = 2,
    integrator: str = "path",
    device: Device = IDEAL,
    lamp: Lamp | None = None,
    relief: Array | None = None,
) -> mi.Scene:
    """The sample, the screen and the environment alone: what the estimators integrate.

    The same bilinear pattern and environment, the same pixel-wise constant material. lamp: one that
    is near, which the estimators do not know. relief: heights (H, W), metres, of a sample that is
    no plane (`invrender.render.height.displaced`).
    """
    emission = {"emitter_samples": 2, "bsdf_samples": 1}
    choice = emission if integrator == "direct" else {"max_depth": max_depth}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, **choice},
            "sample": _sample(rig, maps, relief),
            **_lights(rig, pattern, environment, gain, device),
            **_lamp(lamp),
        }
    )


def scene_dict(maps: Maps, lights: Lights, *, samples: int = 64) -> dict[str, Any]:
    """The sample under its lights as a description for `mitsuba.load_dict`.

    Its BSDF is ours, a plugin that this module registers, whose maps are parameters that carry
    gradients (``sample.bsdf.diffuse`` and so on). Its sensor sees what `invrender.render` renders:
    the sample alone, from the camera, a pixel a texel. A lamp that is near is a sphere.
    """
    rig, (height, width) = lights.rig, maps.shape
    room, lamp = _room_and_lamp(lights)
    x, y, z = (float(c) for c in rig.camera)
    down = [np.array(c, float) for c in ([-1, 0, 0], [0, 1, 0], [0, 0, -1], [x, y, z])]
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": {
            "type": "perspective",
            "fov": fov_of(rig.sample_size / 2 / z),
            "fov_axis": "x",
            "principal_point_offset_x": -x / rig.sample_size,
            "principal_point_offset_y": y / rig.sample_size,
            "near_clip": 1e-3 * z,
            "far_clip": 1e3 * z,
            "to_world": _transform(down),
            "film": {
                "type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb",
                "component_format": "float32", "rfilter": {"type": "box"},
            },
            "sampler": {"type": "multijitter", "sample_count": samples},
        },
        "sample": _sample(rig, maps),
        **_lights(rig, lights.pattern, room, lights.gain, lights.device),
        **_lamp(lamp),
    }  # fmt: skip


def _room_and_lamp(lights: Lights) -> tuple[Array, Lamp | None]:
    """The environment without the lamp that is near, and the even sphere that gives the same light
    where the environment shows the lamp from, and is as large there."""
    if lights.near is None:
        return lights.environment, None
    share = lights.near.share[..., None]
    light = lights.environment * share * solid_angles(*share.shape[:2])[:, None, None]
    flux = light.sum((0, 1), dtype=np.float64)
    # Of an even disc it is the solid angle, and soft borders count by their share.
    spread = float((light * lights.environment * share).sum(dtype=np.float64))
    if spread == 0:
        return lights.environment, None
    solid_angle = min(float(flux @ flux) / spread, np.pi)
    distance = np.linalg.norm(np.subtract(lights.near.place, lights.near.seen_from))
    radius = float(distance * np.sqrt(1 - (1 - solid_angle / (2 * np.pi)) ** 2))
    r, g, b = (float(c) for c in flux / solid_angle)
    return lights.environment * (1 - share), (lights.near.place, radius, (r, g, b))


def _sample(rig: Rig, maps: Maps, relief: Array | None = None) -> Any:
    if relief is not None:
        return _relief(rig, maps, relief)
    half = rig.sample_size / 2
    place = mi.ScalarTransform4f().scale([half, half, 1])
    return {"type": "rectangle", "to_world": place, "bsdf": _bsdf(maps)}


def _relief(rig: Rig, maps: Maps, relief: Array) -> Any:
    """A mesh with a vertex at each pixel's centre, and half a pixel beyond at the border, whose
    normals are the maps': so its BSDF has none of its own."""
    height, width = relief.shape
    half = rig.sample_size / 2
    at = [np.clip(np.arange(-1, n + 1) + 0.5, 0, n) / n * 2 - 1 for n in (width, height)]
    x, y = np.meshgrid(at[0] * half, -at[1] * half)
    z = np.pad(relief, 1, mode="edge")
    normal = np.pad(maps.normal, ((1, 1), (1, 1), (0, 0)), mode="edge")
    index = np.arange(z.size).reshape(z.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, c, b), (b, c, d))])
    flat = Maps(maps.diffuse, maps.specular, maps.roughness, np.zeros_like(maps.normal) + UP)
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(_bsdf(flat))
    mesh = mi.Mesh(
        "relief", z.size, len(faces), has_vertex_normals=True, has_vertex_texcoords=True,
        props=props,
    )  # fmt: skip
    values = {
        "vertex_positions": np.stack([x, y, z], -1),
        "vertex_normals": normal,
        "vertex_texcoords": np.stack([x, y], -1) / (2 * half) + 0.5,
    }
    params = mi.traverse(mesh)
    for name, value in values.items():
        params[name] = mi.Float(value.astype(np.float32).ravel())
    params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
    params.update()
    return mesh


def _bsdf(maps: Maps) -> dict[str, Any]:
    return {
        "type": "invrender",
        "diffuse": mi.TensorXf(maps.diffuse.astype(np.float32)),
        "specular": mi.TensorXf(maps.specular.astype(np.float32)),
        "roughness": mi.TensorXf(maps.roughness[..., None].astype(np.float32)),
        "normal": mi.TensorXf(maps.normal.astype(np.float32)),
    }


def _lights(
    rig: Rig, pattern: Array | None, environment: Array | None, gain: Any, device: Device
) -> dict[str, Any]:
    lights: dict[str, Any] = {}
    if pattern is not None and rig.has_screen:
        corner, (e_x, e_y) = rig.screen_corner, rig.screen_edges
        radiance = {
            "type": "bitmap",
            "bitmap": _bitmap(device.shown(pattern) * np.asarray(gain)),
            "raw": True,
            "wrap_mode": "clamp",
            "format": "variant",
        }
        emitter: dict[str, Any] = {"type": "area", "radiance": radiance}
        if device.falloff:
            place = {"corner": corner, "edge_x": e_x, "edge_y": e_y}
            emitter |= {k: list(map(float, v)) for k, v in place.items()}
            emitter |= {"type": "dimming_screen", "falloff": float(device.falloff)}
        lights["screen"] = _black_rectangle(corner, e_x, e_y) | {"emitter": emitter}
        if rig.screen_bezel:
            corner, (b_x, b_y) = rig.screen_body
            up = np.cross(b_x, b_y)
            lift = up / np.linalg.norm(up) * (SAMPLE_LIFT * max(rig.screen_sides))
            lights["bezel"] = _black_rectangle(corner + lift, b_x, b_y)
    if environment is not None:
        lights["environment"] = {
            "type": "envmap",
            "bitmap": _bitmap(mitsuba_rows(environment)),
            "to_world": _transform(
                [np.array(c, float) for c in ([0, -1, 0], [0, 0, 1], [-1, 0, 0], [0, 0, 0])]
            ),
        }
    return lights


def _lamp(lamp: Lamp | None) -> dict[str, Any]:
    if lamp is None:
        return {}
    centre, radius, radiance = lamp
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": list(map(float, radiance))}}
    return {
        "lamp": {"type": "sphere", "center": list(centre), "radius": radius, "emitter": emitter}
    }


def _mirror(reflectance: Vec3, alpha: float) -> dict[str, Any]:
    rough = {"type": "roughconductor", "distribution": "ggx", "alpha": alpha}
    return {
        **(rough if alpha > 1e-3 else {"type": "conductor"}),
        "material": "none",
        "specular_reflectance": {"type": "rgb", "value": list(reflectance)},
    }


def _paper(
    reflectance: Array, page: tuple[float, float, float, float], depth: float
) -> dict[str, Any]:
    x0, y0, x1, y1 = page
    e_x, e_y = np.array([x1 - x0, 0, 0]), np.array([0, y1 - y0, 0])
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2, -depth])
    image = np.repeat(reflectance[::-1, :, None], 3, -1)  # Mitsuba's row 0 is at -y
    return {
        "type": "rectangle",
        "to_world": _transform([e_x / 2, e_y / 2, np.array([0, 0, 1.0]), middle]),
        "bsdf": {
            "type": "diffuse",
            "reflectance": {
                "type": "bitmap", "bitmap": _bitmap(image), "raw": True, "wrap_mode": "clamp",
            },
        },
    }  # fmt: skip


def _black_rectangle(corner: Array, e_x: Array, e_y: Array) -> dict[str, Any]:
    """Facing down. Mitsuba's rectangle has image row 0 at its -y; turned over, that is +e_y."""
    down = np.cross(e_y, e_x)
    down = down / np.linalg.norm(down)
    return {
        "type": "rectangle",
        "to_world": _transform([e_x / 2, -e_y / 2, down, corner + e_x / 2 + e_y / 2]),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
    }


def path_traced(
    scene: mi.Scene, rig: Rig, height: int, width: int, spp: int, seed: int = 0
) -> Array:
    """Radiance (H, W, 3) at the sample's pixel centres by the scene's own integrator."""
    points = rig.sample_points(height, width).reshape(-1, 3)
    d = points - rig.camera
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    wide = dr.arange(mi.UInt32, len(points) * spp) // spp
    direction = dr.gather(mi.Vector3f, mi.Float(d.ravel().astype(np.float32)), wide)
    ray = mi.RayDifferential3f(mi.Ray3f(o=mi.Point3f(*map(float, rig.camera)), d=direction))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, len(points) * spp)
    color, _, _ = scene.integrator().sample(scene, sampler, ray)
    channels = [dr.block_sum(c, spp) / spp for c in color]
    return np.stack([np.array(c) for c in channels], -1).reshape(height, width, 3)


def photograph(
    rig: Rig,
    maps: Maps,
    pattern: Array,
    environment: Array,
    gain: Any = 1.0,
    *,
    height: int = 960,
    width: int = 1280,
    spp: int = 64,
    max_depth: int = 4,
    table: Any = 0.3,
    seed: int = 0,
    device: Device = IDEAL,
    ball: Vec3 | None = None,
    ball_alpha: float = 0.0,
    cover: tuple[Array, tuple[float, float, float, float]] | None = None,
    lamp: Lamp | None = None,
    relief: Array | None = None,
) -> Array:
    """The whole photo (H, W, 3), linear: sample, mirror ball, diffuse table, light between them.

    ball: its centre where it is not the rig's; ball_alpha: its roughness. cover: what lies on the
    table under the sample, its reflectance (h, w), row 0 at +y, and its least x, least y, greatest
    x and greatest y. lamp: in the room. relief: as for `sample_scene`; the table lies
    below its deepest point.
    """
    size = max(rig.screen_sides) if rig.has_screen else 2 * rig.sample_size
    camera, (right, up, back) = rig.camera, rig.camera_axes
    table = np.broadcast_to(np.asarray(table, dtype=float), 3)
    depth = SAMPLE_LIFT * size - (0.0 if relief is None else min(float(relief.min()), 0.0))
    described: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": max_depth},
        "sensor": {
            "type": "perspective",
            "fov": rig.fov,
            "fov_axis": "x",
            "near_clip": 1e-3 * size,
            "far_clip": 1e3 * size,
            # Mitsuba's camera looks along its z and has its x to the left.
            "to_world": _transform([-right, up, -back, camera]),
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
            "sampler": {"type": "multijitter", "sample_count": spp},
        },
        "sample": _sample(rig, maps, relief),
        "table": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f()
            .translate([0, 0, -depth])
            .scale([100 * size, 100 * size, 1]),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(table)}},
        },
        "ball": {
            "type": "sphere",
            "center": list(map(float, rig.ball_centre if ball is None else ball)),
            "radius": rig.ball_radius,
            "bsdf": _mirror(rig.ball_reflectance, ball_alpha),
        },
        **({} if cover is None else {"cover": _paper(*cover, depth - SAMPLE_LIFT * size / 2)}),
        **_lights(rig, pattern, environment, gain, device),
        **_lamp(lamp),
    }
    photo = _traced(described, spp, seed)
    if lamp is not None:  # its image in the ball is small
        x, y = rig.project(described["ball"]["center"], height, width)
        reach = BALL_WINDOW * rig.focal(width) * rig.ball_radius / camera[2]
        x0, y0 = max(0, int(x - reach)), max(0, int(y - reach))
        x1, y1 = min(width, int(x + reach) + 1), min(height, int(y + reach) + 1)
        if x1 > x0 and y1 > y0:
            crop = {"crop_offset_x": x0, "crop_offset_y": y0, "crop_width": x1 - x0,
                    "crop_height": y1 - y0}  # fmt: skip
            sensor = described["sensor"]
            described["sensor"] = {**sensor, "film": {**sensor["film"], **crop}}
            photo[y0:y1, x0:x1] = _traced(described, LAMP_FACTOR * spp, seed)
    return photo


def _traced(described: dict[str, Any], spp: int, seed: int) -> Array:
    """The scene's image, of `AT_ONCE` samples at a time: a Ctrl-C waits until Mitsuba is done."""
    scene, size = mi.load_dict(described), described["sensor"]["film"]
    pixels = size.get("crop_width", size["width"]) * size.get("crop_height", size["height"])
    parts = math.ceil(pixels * spp / AT_ONCE)
    images = (
        mi.render(scene, spp=math.ceil(spp / parts), seed=seed + k * SEED_STEP)
        for k in range(parts)
    )
    return np.mean([np.array(image) for image in images], 0)
