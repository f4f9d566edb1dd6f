// One object, one point light, the captured room. Lengths in half sample sizes; x right, y up, z to
// the viewer, as in the rig. SHAPE: plane, sphere, cylinder, cloth. SHOW: material, diffuse, specular,
// roughness, normal. LAMP, ROOM: 1 where there is such light.
uniform sampler2D diffuse_map, specular_map, slopes_roughness;
uniform sampler2D irradiance_map, blurred, reflectance_map;
uniform float size;          // of the canvas, pixels a side
uniform vec3 eye;
uniform float reach;         // half the width that is seen at z = 0
uniform mat3 turn;           // object to world
uniform vec3 lamp;
uniform float power;         // of the lamp: π·distance² gives a white sheet facing it radiance 1
uniform float room;          // factor on the room's light
uniform mat3 room_turn;      // world to room
uniform float exposure;
out vec4 colour;

const float RADIUS = 0.8;    // of the cylinder
const float LEVELS = 4.0;    // of the blurred room, one below the other: roughness 1 in the last

struct Hit { float t; vec3 p, n, tangent; vec2 uv; };

#if SHAPE == 0
bool trace(vec3 o, vec3 d, out Hit hit) {
  hit.t = -o.z / d.z;
  hit.p = o + hit.t * d;
  hit.n = vec3(0, 0, 1);
  hit.tangent = vec3(1, 0, 0);
  hit.uv = vec2(hit.p.x, -hit.p.y) * 0.5 + 0.5;
  return d.z < 0.0 && hit.t > 0.0 && max(abs(hit.p.x), abs(hit.p.y)) <= 1.0;
}
#elif SHAPE == 1
bool trace(vec3 o, vec3 d, out Hit hit) {
  float b = dot(o, d), c = dot(o, o) - 1.0, s = b * b - c;
  hit.t = -b - sqrt(max(s, 0.0));
  hit.p = o + hit.t * d;
  hit.n = normalize(hit.p);
  float across = length(hit.n.xz);
  hit.tangent = across > 0.0 ? vec3(hit.n.z, 0, -hit.n.x) / across : vec3(1, 0, 0);
  hit.uv = vec2(atan(hit.n.x, hit.n.z) / PI + 0.5, acos(clamp(hit.n.y, -1.0, 1.0)) / PI);
  return s >= 0.0;
}
#elif SHAPE == 3
// A cloth in folds: a height field over the square, found by steps that its slope bounds.
const vec2 FOLD_A = vec2(3.1, 1.3), FOLD_B = vec2(-1.9, 4.3), FOLD_C = vec2(6.7, -5.2);
const vec3 DEPTHS = vec3(0.1, 0.06, 0.018);
const float TOP = 0.08, BOTTOM = -0.28;  // the sum of the depths above and below the middle
const float STEEPEST = 0.78;             // slope: the depths times the folds' lengths
vec3 phases(vec2 p) {
  return vec3(dot(FOLD_A, p), dot(FOLD_B, p) + 1.0, dot(FOLD_C, p) + 2.0);
}
bool trace(vec3 o, vec3 d, out Hit hit) {
  const int STEPS = 24;
  const float CLOSE = 3e-4;
  float speed = STEEPEST * length(d.xy) - d.z;
  float near = (TOP - o.z) / d.z, far = (BOTTOM - o.z) / d.z;
  hit.t = near;
  for (int i = 0; i < STEPS; i++) {
    hit.p = o + hit.t * d;
    float gap = hit.p.z + 0.1 - dot(DEPTHS, sin(phases(hit.p.xy)));
    hit.t += gap / speed;
    if (gap < CLOSE) break;
  }
  hit.p = o + hit.t * d;
  vec3 k = DEPTHS * cos(phases(hit.p.xy));
  vec2 slope = k.x * FOLD_A + k.y * FOLD_B + k.z * FOLD_C;
  hit.n = normalize(vec3(-slope, 1));
  hit.tangent = normalize(vec3(1, 0, slope.x));
  hit.uv = vec2(hit.p.x, -hit.p.y) * 0.5 + 0.5;
  return d.z < 0.0 && near > 0.0 && hit.t <= far && max(abs(hit.p.x), abs(hit.p.y)) <= 1.0;
}
#else
bool trace(vec3 o, vec3 d, out Hit hit) {
  float a = dot(d.xz, d.xz), b = dot(o.xz, d.xz), c = dot(o.xz, o.xz) - RADIUS * RADIUS;
  float s = b * b - a * c, side = sign(o.y);
  hit.t = (-b - sqrt(max(s, 0.0))) / a;
  hit.p = o + hit.t * d;
  hit.n = vec3(hit.p.x, 0, hit.p.z) / RADIUS;
  hit.tangent = vec3(hit.n.z, 0, -hit.n.x);
  hit.uv = vec2(atan(hit.n.x, hit.n.z) / PI + 0.5, 0.5 - 0.5 * hit.p.y);
  if (s >= 0.0 && abs(hit.p.y) <= 1.0) return true;
  if (side * o.y <= 1.0) return false;
  hit.t = (side - o.y) / d.y;  // the lid
  hit.p = o + hit.t * d;
  hit.n = vec3(0, side, 0);
  hit.tangent = vec3(1, 0, 0);
  hit.uv = vec2(hit.p.x, side * hit.p.z) * 0.5 + 0.5;
  return hit.t > 0.0 && dot(hit.p.xz, hit.p.xz) <= RADIUS * RADIUS;
}
#endif

// Place in an octahedral map [Cigolle et al. 2014]: cheaper than a cube map without a GPU.
vec2 octahedral(vec3 d) {
  vec2 p = d.xy / (abs(d.x) + abs(d.y) + abs(d.z));
  vec2 fold = (1.0 - abs(p.yx)) * mix(vec2(-1), vec2(1), step(0.0, p));
  return (d.z < 0.0 ? fold : p) * 0.5 + 0.5;
}

vec3 blurred_room(vec3 d, float roughness) {
  float width = float(textureSize(blurred, 0).x);
  vec2 at = clamp(octahedral(d), 0.5 / width, 1.0 - 0.5 / width) / vec2(1, LEVELS + 1.0);
  float level = min(roughness * LEVELS, LEVELS - 1e-3);
  at.y += floor(level) / (LEVELS + 1.0);
  return mix(textureLod(blurred, at, 0.0).rgb,
             textureLod(blurred, at + vec2(0, 1.0 / (LEVELS + 1.0)), 0.0).rgb, fract(level));
}

vec3 encode(vec3 c) {
  c = clamp(c, 0.0, 1.0);
  return mix(c * 12.92, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c));
}

void main() {
  vec2 q = (gl_FragCoord.xy / size * 2.0 - 1.0) * reach;
  vec3 o = eye * turn, d = normalize(vec3(q, 0) - eye) * turn;
  Hit hit;
  bool seen = trace(o, d, hit);
  // In texels, from the point's own change from pixel to pixel: it has no seam, uv has.
  float footprint = length(fwidth(hit.p)) * float(textureSize(slopes_roughness, 0).x) / 2.83;
  if (!seen) { colour = vec4(0.055, 0.058, 0.066, 1); return; }
  float lod = max(log2(footprint), 0.0);
#if SHOW == 0 || SHOW == 1
  vec3 k_d = textureLod(diffuse_map, hit.uv, lod).rgb;
#endif
#if SHOW == 0 || SHOW == 2
  vec3 k_s = textureLod(specular_map, hit.uv, lod).rgb;
#endif
  vec3 rest = textureLod(slopes_roughness, hit.uv, lod).xyz;
  // Every other copy of the sample is mirrored.
  vec2 slope = rest.xy * (1.0 - 2.0 * mod(floor(hit.uv), 2.0));
  float up = sqrt(max(1.0 - dot(slope, slope), 0.0));
#if SHOW == 1
  colour = vec4(encode(k_d), 1);
#elif SHOW == 2
  colour = vec4(encode(k_s), 1);
#elif SHOW == 3
  colour = vec4(rest.zzz, 1);
#elif SHOW == 4
  colour = vec4(vec3(slope, up) * 0.5 + 0.5, 1);
#else
  vec3 bitangent = cross(hit.n, hit.tangent);
  vec3 n = turn * normalize(hit.tangent * slope.x + bitangent * slope.y + hit.n * up);
  vec3 p = turn * hit.p;
  mat3 f = frame(n);  // singular for n.z = -1 only, which no visible normal has
  vec3 v = normalize(eye - p) * f;
  v = normalize(vec3(v.xy, max(v.z, MIN_VIEW)));
  vec3 light = vec3(0);
#if LAMP
  vec3 to_lamp = lamp - p;
  if (dot(to_lamp, turn * hit.n) > 0.0) {
    float distance2 = dot(to_lamp, to_lamp), alpha = max(rest.z, MIN_ROUGHNESS);
    vec3 l = (to_lamp * inversesqrt(distance2)) * f;
    vec2 s = specular(l, v, alpha * alpha);
    vec3 fresnel = (1.0 - k_s) * s.y + k_s;
    light += (k_d * (max(l.z, 0.0) / PI) + fresnel * s.x) * (power / distance2);
  }
#endif
#if ROOM
  vec3 shine = blurred_room(room_turn * (f * vec3(-v.xy, v.z)), rest.z);
  vec2 share = textureLod(reflectance_map, vec2(rest.z, v.z), 0.0).xy;
  vec3 e = textureLod(irradiance_map, octahedral(room_turn * n), 0.0).rgb;
  light += room * (k_d / PI * e + shine * (k_s * share.x + share.y));
#endif
  colour = vec4(encode(light * exposure), 1);
#endif
}
