// View-dependent colours of 16 Gaussians, spherical harmonics of degree 3 in the signs of 3D Gaussian Splatting files.
#pragma once

#include "limit_project.h"

namespace {

constexpr int ROW = 3 * COEFFICIENTS;  // floats of one Gaussian

// Unit directions in which the camera sees them, and the inverse distance.
inline Lanes directions(const Gaussians &g, const Camera &c, int first, Lanes *direction) {
  load_group<3>(g.means, first, g.count, direction);
  for (int j = 0; j < 3; j++) direction[j] -= c.center[j];
  const Lanes *d = direction;
  const Lanes inverse = 1.0f / root(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
  for (int j = 0; j < 3; j++) direction[j] *= inverse;
  return inverse;
}

inline void basis(const Lanes *direction, Lanes *Y) {
  const Lanes x = direction[0], y = direction[1], z = direction[2];
  const Lanes five = 5.0f * z * z - 1.0f, lean = x * x - y * y;
  Y[0] = all(0.28209479f);
  Y[1] = -0.48860251f * y, Y[2] = 0.48860251f * z, Y[3] = -0.48860251f * x;
  Y[4] = 1.09254843f * x * y, Y[5] = -1.09254843f * y * z, Y[6] = 0.31539157f * (3.0f * z * z - 1.0f);
  Y[7] = -1.09254843f * x * z, Y[8] = 0.54627422f * lean;
  Y[9] = -0.59004359f * y * (3.0f * x * x - y * y), Y[10] = 2.89061144f * x * y * z, Y[11] = -0.45704580f * y * five;
  Y[12] = 0.37317633f * z * (five - 2.0f), Y[13] = -0.45704580f * x * five, Y[14] = 1.44530572f * z * lean;
  Y[15] = -0.59004359f * x * (x * x - 3.0f * y * y);
}

// One third of the coefficients of the visible, transposed: rows[e] holds number 16 third + e of every Gaussian.
inline void load_third(const float *sh, int first, Mask visible, int third, Lanes *rows) {
  for (int i = 0; i < 16; i++) rows[i] = load_if(visible >> i & 1, sh + (size_t)ROW * (first + i) + 16 * third);
  transpose(rows);
}

inline void shade_group(const Gaussians &g, const Camera &c, int first, Group &group, Splat *splats) {
  Lanes direction[3], Y[16], rows[16], color[3];
  directions(g, c, first, direction);
  basis(direction, Y);
  for (int j = 0; j < 3; j++) color[j] = all(0.5f);
  for (int third = 0; third < 3; third++) {
    load_third(g.values, first, group.visible, third, rows);
    for (int e = 0; e < 16; e++) color[(16 * third + e) % 3] += Y[(16 * third + e) / 3] * rows[e];
  }
  float values[3][16];
  for (int j = 0; j < 3; j++) {
    group.shown[j] = greater(color[j], Lanes{}, group.visible);
    store(values[j], masked(group.shown[j], color[j]));
  }
  for (uint32_t left = group.visible; left; left &= left - 1, splats++) {
    const int i = __builtin_ctz(left);
    splats->r = values[0][i], splats->g = values[1][i], splats->b = values[2][i];
  }
}

// v_color holds the gradient of the colours; v_means is added to, v_sh is written.
inline void shade_group_backward(const Gaussians &g, const Camera &c, int first, const Group &group,
                                 const Lanes *v_color, float *v_means, float *v_sh) {
  Lanes direction[3], Y[16], rows[16], v[3], s[16] = {};
  const int here = std::min(16, g.count - first);
  if (!group.visible) {
    for (int k = 0; k < 3 * here; k++) stream(v_sh + (size_t)ROW * first + 16 * k, Lanes{});
    return;
  }
  const Lanes inverse = directions(g, c, first, direction);
  basis(direction, Y);
  for (int k = 0; k < 16; k++) Y[k] = masked(group.visible, Y[k]);
  for (int j = 0; j < 3; j++) v[j] = masked(group.shown[j], v_color[j]);
  for (int third = 0; third < 3; third++) {
    load_third(g.values, first, group.visible, third, rows);
    for (int e = 0; e < 16; e++) s[(16 * third + e) / 3] += rows[e] * v[(16 * third + e) % 3];
    for (int e = 0; e < 16; e++) rows[e] = Y[(16 * third + e) / 3] * v[(16 * third + e) % 3];
    transpose(rows);
    for (int i = 0; i < here; i++) stream(v_sh + (size_t)ROW * (first + i) + 16 * third, rows[i]);
  }
  const Lanes x = direction[0], y = direction[1], z = direction[2];
  const Lanes five = 5.0f * z * z - 1.0f, lean = x * x - y * y;
  const Lanes s4 = 1.09254843f * s[4], s5 = -1.09254843f * s[5], s7 = -1.09254843f * s[7], s8 = 1.09254843f * s[8];
  const Lanes s9 = -1.77013077f * s[9], s10 = 2.89061144f * s[10], s11 = -0.45704580f * s[11];
  const Lanes s12 = 1.11952900f * s[12], s13 = -0.45704580f * s[13], s14 = 1.44530572f * s[14];
  const Lanes s15 = -1.77013077f * s[15];
  Lanes d[3], mean[3];
  d[0] = -0.48860251f * s[3] + y * s4 + z * s7 + x * s8 + 2.0f * x * y * s9 + y * z * s10 + five * s13 +
         2.0f * x * z * s14 + lean * s15;
  d[1] = -0.48860251f * s[1] + x * s4 + z * s5 - y * s8 + lean * s9 + x * z * s10 + five * s11 - 2.0f * y * z * s14 -
         2.0f * x * y * s15;
  d[2] = 0.48860251f * s[2] + y * s5 + x * s7 + 1.89234939f * z * s[6] + x * y * s10 + 10.0f * z * (y * s11 + x * s13) +
         five * s12 + lean * s14;
  const Lanes along = x * d[0] + y * d[1] + z * d[2];
  load_group<3>(v_means, first, g.count, mean);
  for (int j = 0; j < 3; j++) mean[j] += masked(group.visible, (d[j] - direction[j] * along) * inverse);
  store_group<3>(mean, 0xffff, first, g.count, v_means);
}

}  // namespace
