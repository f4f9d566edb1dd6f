// The BRDF of invrender/brdf.py, line by line; the tests compare the two.
const float PI = 3.14159265358979;
const float MIN_VIEW = 1e-4;
const float MIN_ROUGHNESS = 1e-3;

// Columns: tangents s, t and the normal, for n.z > -1.
mat3 frame(vec3 n) {
  float a = -1.0 / (1.0 + n.z), b = n.x * n.y * a;
  return mat3(1.0 + n.x * n.x * a, b, -n.x, b, 1.0 + n.y * n.y * a, -n.y, n);
}

float ggx_d(vec3 h, float alpha) {
  float a2 = alpha * alpha;
  float e = a2 * h.z * h.z + h.x * h.x + h.y * h.y;
  return a2 / (PI * e * e);
}

float schlick(float v_dot_h) {
  float x = max(1.0 - v_dot_h, 0.0), x2 = x * x;
  return x2 * x2 * x;
}

// D G2 / (4 n.l n.v) (n.l) and Schlick's weight, in the shading frame.
vec2 specular(vec3 l, vec3 v, float alpha) {
  if (l.z <= 0.0 || v.z <= 0.0) return vec2(0);
  vec3 h = normalize(l + v);
  float a2 = alpha * alpha;
  float root_l = sqrt(a2 * dot(l.xy, l.xy) + l.z * l.z);
  float root_v = sqrt(a2 * dot(v.xy, v.xy) + v.z * v.z);
  float visibility = 1.0 / (2.0 * (v.z * root_l + l.z * root_v));
  return vec2(ggx_d(h, alpha) * visibility * l.z, schlick(dot(v, h)));
}

vec3 sample_vndf(vec3 v, float alpha, vec2 u) {
  vec3 w = normalize(vec3(alpha * v.xy, v.z));
  float phi = 2.0 * PI * u.x, z = (1.0 - u.y) * (1.0 + w.z) - w.z;
  float r = sqrt(max(1.0 - z * z, 0.0));
  vec3 h = vec3(r * cos(phi), r * sin(phi), z) + w;
  return normalize(vec3(alpha * h.xy, h.z));
}

float pdf_vndf(vec3 l, vec3 v, float alpha) {
  if (l.z <= 0.0 || v.z <= 0.0) return 0.0;
  float root_v = sqrt(alpha * alpha * dot(v.xy, v.xy) + v.z * v.z);
  return ggx_d(normalize(l + v), alpha) / (2.0 * (v.z + root_v));
}
