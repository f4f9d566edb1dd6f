// What is computed once, by PASS: slopes and roughness from their bytes, the room's irradiance and its
// blurred copies as octahedral maps, and the share of light that the specular lobe reflects.
uniform sampler2D high_bytes, low_bytes, room;
uniform float size;        // of the target, pixels a side
uniform float row;         // of the target that this is drawn from
uniform float roughness;   // of the blurred copy
uniform vec3 table;        // radiance from below the horizon
out vec4 result;

// Direction of this pixel of an octahedral map; its border is all below the horizon.
vec3 direction() {
  vec2 p = (gl_FragCoord.xy - vec2(0, row)) / size * 2.0 - 1.0;
  float z = 1.0 - abs(p.x) - abs(p.y);
  vec2 fold = (1.0 - abs(p.yx)) * mix(vec2(-1), vec2(1), step(0.0, p));
  return normalize(vec3(z < 0.0 ? fold : p, z));
}

vec3 radiance(vec3 d, float lod) {
  vec2 uv = vec2(atan(d.y, d.x) / (2.0 * PI), acos(clamp(d.z, -1.0, 1.0)) / PI);
  return d.z > 0.0 ? textureLod(room, uv, lod).rgb : table;
}

vec2 hammersley(int i, int n) {
  uint b = uint(i);
  b = (b << 16u) | (b >> 16u);
  b = ((b & 0x55555555u) << 1u) | ((b & 0xAAAAAAAAu) >> 1u);
  b = ((b & 0x33333333u) << 2u) | ((b & 0xCCCCCCCCu) >> 2u);
  b = ((b & 0x0F0F0F0Fu) << 4u) | ((b & 0xF0F0F0F0u) >> 4u);
  b = ((b & 0x00FF00FFu) << 8u) | ((b & 0xFF00FF00u) >> 8u);
  return vec2((float(i) + 0.5) / float(n), float(b) * 2.3283064365386963e-10);
}

#if PASS == 0
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec3 words = floor(texelFetch(high_bytes, at, 0).rgb * 255.0 + 0.5) * 256.0
             + floor(texelFetch(low_bytes, at, 0).rgb * 255.0 + 0.5);
  result = vec4((words.xy - 32768.0) / 32767.0, words.z / 65535.0, 1);
}
#elif PASS == 1
void main() {  // ∫ L (n·l) dω over a coarse copy of the room
  vec3 n = direction(), sum = vec3(0);
  const ivec2 grid = ivec2(48, 24);
  for (int y = 0; y < grid.y; y++)
    for (int x = 0; x < grid.x; x++) {
      float phi = 2.0 * PI * (float(x) + 0.5) / float(grid.x);
      float theta = PI * (float(y) + 0.5) / float(grid.y);
      vec3 d = vec3(sin(theta) * cos(phi), sin(theta) * sin(phi), cos(theta));
      float solid_angle = sin(theta) * 2.0 * PI * PI / float(grid.x * grid.y);
      sum += radiance(d, log2(float(textureSize(room, 0).x) / float(grid.x)))
           * max(dot(n, d), 0.0) * solid_angle;
    }
  result = vec4(sum, 1);
}
#elif PASS == 2
void main() {  // the room as a specular lobe sees it that looks along its own normal
  vec3 n = direction(), sum = vec3(0);
  if (roughness == 0.0) { result = vec4(radiance(n, 0.0), 1); return; }
  mat3 f = frame(vec3(n.xy, abs(n.z)));
  if (n.z < 0.0) f = mat3(f[0] * vec3(1, 1, -1), f[1] * vec3(1, 1, -1), n);
  const int samples = 128;
  float alpha = roughness * roughness, weight = 0.0;
  vec2 texels = vec2(textureSize(room, 0));
  for (int i = 0; i < samples; i++) {
    vec3 h = sample_vndf(vec3(0, 0, 1), alpha, hammersley(i, samples));
    vec3 l = vec3(2.0 * h.z * h.xy, 2.0 * h.z * h.z - 1.0);
    if (l.z <= 0.0) continue;
    float area = 1.0 / (float(samples) * max(pdf_vndf(l, vec3(0, 0, 1), alpha), 1e-6));
    float texel = 2.0 * PI * PI / (texels.x * texels.y);
    sum += radiance(f * l, max(0.5 * log2(area / texel) + 0.5, 0.0)) * l.z;
    weight += l.z;
  }
  result = vec4(sum / weight, 1);
}
#else
void main() {  // reflected light = k_s·x + y, over (roughness, n·v)
  vec2 uv = gl_FragCoord.xy / size;
  float alpha = max(uv.x * uv.x, 1e-4);
  vec3 v = vec3(sqrt(1.0 - uv.y * uv.y), 0, uv.y);
  const int samples = 128;
  vec2 sum = vec2(0);
  for (int i = 0; i < samples; i++) {
    vec3 h = sample_vndf(v, alpha, hammersley(i, samples));
    vec3 l = 2.0 * dot(v, h) * h - v;
    if (l.z <= 0.0) continue;
    vec2 f = specular(l, v, alpha);
    sum += f.x / pdf_vndf(l, v, alpha) * vec2(1.0 - f.y, f.y);
  }
  result = vec4(sum / float(samples), 0, 1);
}
#endif
