#version 300 es
// One instance = one Gaussian = one quad. The arithmetic is that of stages/splatting (3DGS with EWA
// splatting, Zwicker et al. 2001): covariance into the image through the Jacobian of the
// projection, low-pass, cut where alpha falls under ALPHA_MIN.
precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D u_splats;      // TEXELS texels a splat, PER_ROW splats a row; see decode.js
uniform mat3 u_rotation;          // cam_from_world
uniform vec3 u_translation;
uniform vec3 u_centre;            // projection centre in the world
uniform vec2 u_focal;             // pixels
uniform vec2 u_principal;
uniform vec2 u_size;              // viewport in pixels
uniform vec2 u_slope_min;         // bounds of x/z and y/z in the Jacobian
uniform vec2 u_slope_max;
uniform float u_near;
uniform usampler2D u_flags;       // bits 0-1: jaw, 2-7: photographs that saw it; see compact.py
uniform int u_jaw;                // 0: all, 1: upper, 2: lower
uniform vec4 u_cut;               // what lies beyond this plane is cut away
uniform bool u_support;           // tint what no photograph, or only one, has seen
#if LIT
uniform float u_light[8];         // k, p, m and s of both lobes, distance, gamma: light.py
uniform float u_exposure;
#endif

in uint a_splat;

out vec2 v_offset;                // from the centre, in standard deviations along the main axes
flat out vec4 v_colour;           // rgb, opacity

uvec4 texel(int k) {
  int splat = int(a_splat);
  return texelFetch(u_splats, ivec2((splat % PER_ROW) * TEXELS + k, splat / PER_ROW), 0);
}

// Quaternion (wxyz) from 2 bits "which component is the largest" and 3 x 10 bits of the others.
vec4 quaternion(uint bits) {
  vec3 rest = (vec3(float(bits & 1023u), float((bits >> 10) & 1023u), float((bits >> 20) & 1023u))
      / 1023.0 * 2.0 - 1.0) * 0.70710678;
  float largest = sqrt(max(0.0, 1.0 - dot(rest, rest)));
  uint place = bits >> 30;
  if (place == 0u) return vec4(largest, rest);
  if (place == 1u) return vec4(rest.x, largest, rest.yz);
  if (place == 2u) return vec4(rest.xy, largest, rest.z);
  return vec4(rest, largest);
}

mat3 rotation(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(  // columns
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

#if SH_DEGREE > 0
// Half number h of the coefficients after the constant, [coefficient][channel].
float half_number(uvec4 shape, int h) {
  if (h == 0) return unpackHalf2x16(shape.w).y;
  int j = h - 1;
  vec2 pair = unpackHalf2x16(texel(2 + j / 8)[(j % 8) / 2]);
  return (j % 2 == 0) ? pair.x : pair.y;
}

vec3 coefficient(uvec4 shape, int k) {
  int h = 3 * (k - 1);
  return vec3(half_number(shape, h), half_number(shape, h + 1), half_number(shape, h + 2));
}
#endif

#if LIT
// stages/splatting/light.py: one light beside the lens, on albedo (in c) and normal.
vec3 lit(uvec4 shape, vec3 c, vec3 to_eye, float distance) {
  float cosine = dot(normalize(coefficient(shape, 1)), to_eye);
  float fall = u_exposure * pow(u_light[6] / distance, u_light[1]);
  float diffuse = 1.0 - u_light[0] + u_light[0] * max(cosine, 0.0);
  float lobes = u_light[3] * exp(u_light[2] * (cosine - 1.0))
      + u_light[5] * exp(u_light[4] * (cosine - 1.0));
  vec3 radiance = fall * (pow(max(c, 1e-3), vec3(u_light[7])) * diffuse + lobes);
  return pow(max(radiance, 1e-5), vec3(1.0 / u_light[7]));
}
#endif

vec3 colour(uvec4 shape, vec3 d, float distance) {
  vec3 c = 0.5 + 0.28209479177387814 * vec3(unpackHalf2x16(shape.z), unpackHalf2x16(shape.w).x);
#if LIT
  return lit(shape, c, -d, distance);
#endif
#if SH_DEGREE > 0
  c += 0.4886025119029199 * (-d.y * coefficient(shape, 1) + d.z * coefficient(shape, 2)
      - d.x * coefficient(shape, 3));
#endif
#if SH_DEGREE > 1
  float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
  c += 1.0925484305920792 * d.x * d.y * coefficient(shape, 4)
      - 1.0925484305920792 * d.y * d.z * coefficient(shape, 5)
      + 0.31539156525252005 * (2.0 * zz - xx - yy) * coefficient(shape, 6)
      - 1.0925484305920792 * d.x * d.z * coefficient(shape, 7)
      + 0.5462742152960396 * (xx - yy) * coefficient(shape, 8);
#endif
#if SH_DEGREE > 2
  c += -0.5900435899266435 * d.y * (3.0 * xx - yy) * coefficient(shape, 9)
      + 2.890611442640554 * d.x * d.y * d.z * coefficient(shape, 10)
      - 0.4570457994644658 * d.y * (4.0 * zz - xx - yy) * coefficient(shape, 11)
      + 0.3731763325901154 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(shape, 12)
      - 0.4570457994644658 * d.x * (4.0 * zz - xx - yy) * coefficient(shape, 13)
      + 1.445305721320277 * d.z * (xx - yy) * coefficient(shape, 14)
      - 0.5900435899266435 * d.x * (xx - 3.0 * yy) * coefficient(shape, 15);
#endif
  return max(c, 0.0);
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  // outside the clip volume, until proven visible
  v_offset = vec2(0.0);
  v_colour = vec4(0.0);

  uvec4 place = texel(0);
  vec3 mean = uintBitsToFloat(place.xyz);
  vec3 p = u_rotation * mean + u_translation;
  if (p.z < u_near) return;
  uint flags = texelFetch(u_flags, ivec2(int(a_splat) % PER_ROW, int(a_splat) / PER_ROW), 0).r;
  if (u_jaw > 0 && int(flags & 3u) != u_jaw) return;
  if (dot(u_cut.xyz, mean) > u_cut.w) return;

  uvec4 shape = texel(1);
  vec2 log_scale_z_opacity = unpackHalf2x16(shape.y);
  vec3 scale = exp(vec3(unpackHalf2x16(shape.x), log_scale_z_opacity.x));
  float opacity = log_scale_z_opacity.y;

  // Covariance in the image: A A' with A = J W R S.
  vec2 slope = clamp(p.xy / p.z, u_slope_min, u_slope_max);
  mat3 axes = u_rotation * rotation(quaternion(place.w));
  vec3 row_x = vec3(0.0), row_y = vec3(0.0);
  for (int k = 0; k < 3; k++) {
    row_x[k] = u_focal.x / p.z * (axes[k].x - slope.x * axes[k].z) * scale[k];
    row_y[k] = u_focal.y / p.z * (axes[k].y - slope.y * axes[k].z) * scale[k];
  }
  float a = dot(row_x, row_x) + LOW_PASS;
  float b = dot(row_x, row_y);
  float c = dot(row_y, row_y) + LOW_PASS;

  float cut = opacity / ALPHA_MIN;  // alpha >= ALPHA_MIN needs exp(-r^2/2) >= 1/cut
  if (cut <= 1.0) return;
  float reach = sqrt(2.0 * log(cut));

  float middle = 0.5 * (a + c);
  float spread = length(vec2(0.5 * (a - c), b));
  float major = middle + spread;
  float minor = max(middle - spread, 1e-6);
  vec2 axis = a >= c ? vec2(0.5 * (a - c) + spread, b) : vec2(b, 0.5 * (c - a) + spread);
  axis = spread > 1e-9 * middle ? normalize(axis) : vec2(1.0, 0.0);

  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  v_offset = corner * reach;
  vec2 pixel = u_focal * p.xy / p.z + u_principal
      + axis * (sqrt(major) * v_offset.x) + vec2(-axis.y, axis.x) * (sqrt(minor) * v_offset.y);
  gl_Position = vec4(2.0 * pixel.x / u_size.x - 1.0, 1.0 - 2.0 * pixel.y / u_size.y, 0.0, 1.0);
  vec3 ray = mean - u_centre;
  v_colour = vec4(colour(shape, normalize(ray), length(ray)), opacity);
  if (u_support && flags < 8u) {
    vec4 tint = flags < 4u ? vec4(0.90, 0.0, 0.78, 0.65) : vec4(1.0, 0.78, 0.1, 0.35);
    v_colour.rgb = mix(v_colour.rgb, tint.rgb, tint.a);
  }
}
