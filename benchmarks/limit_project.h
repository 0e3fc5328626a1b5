// Gaussians to splats and back, 16 Gaussians at a time: projection, spherical harmonics of degree 3, their gradients.
#pragma once

#include "limit_lanes.h"

namespace {

constexpr int CHUNK = 1024;        // Gaussians whose splats lie together, without gaps
constexpr int COEFFICIENTS = 16;   // of each colour channel
constexpr float DILATION = 0.3f;   // added to both variances [pixels^2]
constexpr float SLACK = 1e-4f;     // widens footprints by this many powers of two: culling errs on the safe side

struct Camera {
  float rotation[9], center[3];  // world to camera; [m]
  float focal[2], principal[2];  // [pixels]
  float low[2], high[2];         // bounds of x/z and y/z in the Jacobian
  float near, far;               // [m]
  int32_t width, height;
};

struct alignas(64) Splat {
  float x, y;        // centre [pixels]
  float A, B, C, L;  // log2 alpha = A dx^2 + B dx dy + C dy^2 + L
  float ridge;       // dx of the largest alpha on a row, over dy
  float r, g, b;
  float half_width, half_height;  // of the footprint [pixels]
  float depth;                    // [m]
  int32_t gaussian;
};

struct Gaussians {
  int count;
  const float *means, *quats, *scales, *opacities;  // [N, 3], [N, 4], [N, 3], [N]
  const float *values;                              // coefficients [N, 16, 3] or features
};

// What a pass over the visible Gaussians needs to find their splats, for every 16 Gaussians.
struct Group {
  int32_t first;   // splat of the first visible one; the others follow
  Mask visible;
  Mask shown[3];   // those whose channel was not clamped at zero
};

template <int K> inline void load_group(const float *from, int first, int count, Lanes *out) {
  if (first + 16 <= count) return deinterleave<K>(from + (size_t)K * first, out);
  float padded[16 * K] = {};
  std::memcpy(padded, from + (size_t)K * first, sizeof(float) * K * (count - first));
  deinterleave<K>(padded, out);
}

template <int K> inline void store_group(const Lanes *from, Mask where, int first, int count, float *to) {
  Lanes values[K];
  for (int k = 0; k < K; k++) values[k] = masked(where, from[k]);
  if (first + 16 <= count) return interleave<K>(values, to + (size_t)K * first);
  float padded[16 * K];
  interleave<K>(values, padded);
  std::memcpy(to + (size_t)K * first, padded, sizeof(float) * K * (count - first));
}

// 16 Gaussians.
struct Parameters {
  Lanes mean[3], quat[4], scale[3], opacity;

  Parameters(const Gaussians &g, int first) {
    load_group<3>(g.means, first, g.count, mean);
    load_group<4>(g.quats, first, g.count, quat);
    load_group<3>(g.scales, first, g.count, scale);
    load_group<1>(g.opacities, first, g.count, &opacity);
  }
};

// The same seen by a camera.
struct Shape {
  Lanes point[3], inv_z, x, y, tx, ty;  // in the camera; over z; the same within the Jacobian's bounds
  Lanes row_x[2], row_y[2];             // of the Jacobian: entries (0, 2) and (1, 2)
  Lanes unit[4], inv_length;            // the quaternion
  Lanes axes[9];                        // camera from Gaussian
  Lanes along_x[3], along_y[3];         // projected axes of length one
  Lanes m_x[3], m_y[3];                 // and of the Gaussian's: the covariance is their product
  Lanes xx, xy, yy, determinant;

  Shape(const Camera &c, const Parameters &g) {
    const Lanes *mean = g.mean, *quat = g.quat, *scale = g.scale;
    Lanes away[3], turn[9];
    for (int j = 0; j < 3; j++) away[j] = mean[j] - c.center[j];
    const float *R = c.rotation;
    for (int j = 0; j < 3; j++) point[j] = R[3 * j] * away[0] + R[3 * j + 1] * away[1] + R[3 * j + 2] * away[2];
    inv_z = 1.0f / point[2];
    x = point[0] * inv_z, y = point[1] * inv_z;
    tx = clamp(x, c.low[0], c.high[0]), ty = clamp(y, c.low[1], c.high[1]);
    row_x[0] = c.focal[0] * inv_z, row_x[1] = -tx * row_x[0];
    row_y[0] = c.focal[1] * inv_z, row_y[1] = -ty * row_y[0];
    inv_length = 1.0f / root(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
    for (int j = 0; j < 4; j++) unit[j] = quat[j] * inv_length;
    rotation(turn);
    for (int i = 0; i < 3; i++)
      for (int j = 0; j < 3; j++)
        axes[3 * i + j] = R[3 * i] * turn[j] + R[3 * i + 1] * turn[3 + j] + R[3 * i + 2] * turn[6 + j];
    for (int j = 0; j < 3; j++) {
      along_x[j] = row_x[0] * axes[j] + row_x[1] * axes[6 + j];
      along_y[j] = row_y[0] * axes[3 + j] + row_y[1] * axes[6 + j];
      m_x[j] = along_x[j] * scale[j], m_y[j] = along_y[j] * scale[j];
    }
    xx = m_x[0] * m_x[0] + m_x[1] * m_x[1] + m_x[2] * m_x[2];
    xy = m_x[0] * m_y[0] + m_x[1] * m_y[1] + m_x[2] * m_y[2];
    yy = m_y[0] * m_y[0] + m_y[1] * m_y[1] + m_y[2] * m_y[2];
    const Lanes p = m_x[1] * m_y[2] - m_x[2] * m_y[1], q = m_x[2] * m_y[0] - m_x[0] * m_y[2];
    const Lanes r = m_x[0] * m_y[1] - m_x[1] * m_y[0];
    determinant = p * p + q * q + r * r + DILATION * (xx + yy) + DILATION * DILATION;
    xx += DILATION, yy += DILATION;
  }

  void rotation(Lanes *turn) const {
    const Lanes w = unit[0], i = unit[1], j = unit[2], k = unit[3];
    turn[0] = 1.0f - 2.0f * (j * j + k * k), turn[1] = 2.0f * (i * j - w * k), turn[2] = 2.0f * (i * k + w * j);
    turn[3] = 2.0f * (i * j + w * k), turn[4] = 1.0f - 2.0f * (i * i + k * k), turn[5] = 2.0f * (j * k - w * i);
    turn[6] = 2.0f * (i * k - w * j), turn[7] = 2.0f * (j * k + w * i), turn[8] = 1.0f - 2.0f * (i * i + j * j);
  }
};

inline Lanes magnitude(const Lanes *v, int count) {
  Lanes total = {};
  for (int k = 0; k < count; k++) total += larger(v[k], -v[k]);
  return total;
}

// Splats of the visible among 16 Gaussians go to `out`, without gaps; returns which they are.
inline Mask project_group(const Gaussians &g, const Camera &c, int first, Splat *out) {
  const Parameters p(g, first);
  const Shape s(c, p);
  const Lanes everything =
      magnitude(p.mean, 3) + magnitude(p.quat, 4) + magnitude(p.scale, 3) + magnitude(&p.opacity, 1);
  // By bits: -ffast-math takes every number for finite.
  const int32_t EXPONENT = 0x7f800000;
  const Mask broken = equal((Ints)everything & EXPONENT, EXPONENT) | equal((Ints)s.determinant & EXPONENT, EXPONENT);
  const Lanes length2 = p.quat[0] * p.quat[0] + p.quat[1] * p.quat[1] + p.quat[2] * p.quat[2] + p.quat[3] * p.quat[3];
  Mask visible = greater_equal(p.opacity, all(ALPHA_MIN)) & greater_equal(length2, all(1e-6f)) & ~broken;
  visible = greater(s.point[2], all(c.near), visible) & greater(all(c.far), s.point[2], visible);
  visible = greater(s.determinant, Lanes{}, visible);

  Lanes row[16] = {};
  const Lanes x = c.focal[0] * s.x + c.principal[0], y = c.focal[1] * s.y + c.principal[1];
  const Lanes level = log2(larger(p.opacity, all(ALPHA_MIN)));
  const Lanes reach = (level + (SLACK - std::log2(ALPHA_MIN))) * (2.0f / LOG2E);
  const Lanes half_width = root(reach * s.xx), half_height = root(reach * s.yy);
  visible &= greater_equal(x + half_width, all(0.5f)) & greater_equal(all(c.width - 0.5f), x - half_width);
  visible &= greater_equal(y + half_height, all(0.5f)) & greater_equal(all(c.height - 0.5f), y - half_height);
  if (first + 16 > g.count) visible &= (1u << (g.count - first)) - 1;
  if (!visible) return 0;
  const Lanes sharp = LOG2E / s.determinant;
  row[0] = x, row[1] = y;
  row[2] = -0.5f * sharp * s.yy, row[3] = sharp * s.xy, row[4] = -0.5f * sharp * s.xx, row[5] = level;
  row[6] = s.xy / s.yy;
  row[10] = half_width, row[11] = half_height, row[12] = s.point[2];
  row[13] = (Lanes)(__builtin_convertvector(IOTA, Ints) + first);
  transpose(row);
  for (uint32_t left = visible; left; left &= left - 1) store((float *)out++, row[__builtin_ctz(left)]);
  return visible;
}

// From the sums of g d^i, d = pixel - centre, under 1, dx, dy, dx^2, dx dy, dy^2, to the gradients of 16 Gaussians.
inline void project_group_backward(const Gaussians &g, const Camera &c, int first, Mask visible, const Lanes *sum,
                                   float *v_means, float *v_quats, float *v_scales, float *v_opacities) {
  const Parameters p(g, first);
  const Shape s(c, p);
  const Lanes inverse = 1.0f / s.determinant;
  const Lanes qa = s.yy * inverse, qb = -s.xy * inverse, qc = s.xx * inverse;  // Q, the conic
  const Lanes v_x = qa * sum[1] + qb * sum[2], v_y = qb * sum[1] + qc * sum[2];
  // dL/dM = Q (sum g d d^T) Q M.
  Lanes v_along_x[3], v_along_y[3], v_scale[3];
  for (int j = 0; j < 3; j++) {
    const Lanes n_x = qa * s.m_x[j] + qb * s.m_y[j], n_y = qb * s.m_x[j] + qc * s.m_y[j];
    const Lanes d_x = sum[3] * n_x + sum[4] * n_y, d_y = sum[4] * n_x + sum[5] * n_y;
    const Lanes m_x = qa * d_x + qb * d_y, m_y = qb * d_x + qc * d_y;
    v_scale[j] = m_x * s.along_x[j] + m_y * s.along_y[j];
    v_along_x[j] = m_x * p.scale[j], v_along_y[j] = m_y * p.scale[j];
  }
  // The Jacobian's rows are fx (1, 0, -tx) / z and fy (0, 1, -ty) / z; where clamped, it does not depend on x/z, y/z.
  Lanes row_x[3], row_y[3], v_axes[9], v_turn[9], v_point[3], v_mean[3], v_quat[4];
  for (int i = 0; i < 3; i++) {
    const Lanes *axis = s.axes + 3 * i;
    row_x[i] = axis[0] * v_along_x[0] + axis[1] * v_along_x[1] + axis[2] * v_along_x[2];
    row_y[i] = axis[0] * v_along_y[0] + axis[1] * v_along_y[1] + axis[2] * v_along_y[2];
  }
  const Mask free_x = greater_equal(s.tx, s.x) & greater_equal(s.x, s.tx);
  const Mask free_y = greater_equal(s.ty, s.y) & greater_equal(s.y, s.ty);
  const Lanes g_x = c.focal[0] * v_x - masked(free_x, s.row_x[0] * row_x[2]);
  const Lanes g_y = c.focal[1] * v_y - masked(free_y, s.row_y[0] * row_y[2]);
  const Lanes g_inv = c.focal[0] * (row_x[0] - s.tx * row_x[2]) + c.focal[1] * (row_y[1] - s.ty * row_y[2]);
  v_point[0] = g_x * s.inv_z, v_point[1] = g_y * s.inv_z;
  v_point[2] = -(s.x * g_x + s.y * g_y + g_inv * s.inv_z) * s.inv_z;
  for (int j = 0; j < 3; j++) {
    v_axes[j] = s.row_x[0] * v_along_x[j], v_axes[3 + j] = s.row_y[0] * v_along_y[j];
    v_axes[6 + j] = s.row_x[1] * v_along_x[j] + s.row_y[1] * v_along_y[j];
  }
  const float *R = c.rotation;
  for (int i = 0; i < 3; i++) {
    v_mean[i] = R[i] * v_point[0] + R[3 + i] * v_point[1] + R[6 + i] * v_point[2];
    for (int j = 0; j < 3; j++)
      v_turn[3 * i + j] = R[i] * v_axes[j] + R[3 + i] * v_axes[3 + j] + R[6 + i] * v_axes[6 + j];
  }
  const Lanes *v = v_turn, w = s.unit[0], x = s.unit[1], y = s.unit[2], z = s.unit[3];
  const Lanes yz = v[7] - v[5], zx = v[2] - v[6], xy = v[3] - v[1];
  const Lanes s_xy = v[1] + v[3], s_xz = v[2] + v[6], s_yz = v[5] + v[7];
  v_quat[0] = 2.0f * (x * yz + y * zx + z * xy);
  v_quat[1] = 2.0f * (w * yz + y * s_xy + z * s_xz - 2.0f * x * (v[4] + v[8]));
  v_quat[2] = 2.0f * (w * zx + x * s_xy + z * s_yz - 2.0f * y * (v[0] + v[8]));
  v_quat[3] = 2.0f * (w * xy + x * s_xz + y * s_yz - 2.0f * z * (v[0] + v[4]));
  const Lanes radial = w * v_quat[0] + x * v_quat[1] + y * v_quat[2] + z * v_quat[3];
  for (int j = 0; j < 4; j++) v_quat[j] = (v_quat[j] - s.unit[j] * radial) * s.inv_length;
  const Lanes v_opacity = sum[0] / p.opacity;
  store_group<3>(v_mean, visible, first, g.count, v_means);
  store_group<4>(v_quat, visible, first, g.count, v_quats);
  store_group<3>(v_scale, visible, first, g.count, v_scales);
  store_group<1>(&v_opacity, visible, first, g.count, v_opacities);
}

}  // namespace
