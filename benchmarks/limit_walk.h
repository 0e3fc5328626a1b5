// Compositing of tile lists by hand, forward and backward: 16 pixels of a row at a time.
//
// A thread owns a 16 x 16 tile. Its list of Gaussians comes front to back. For each of them one vector operation over
// the 16 rows finds the rows it reaches; those rows are composited 16 pixels at a time, their state being in L1.
#pragma once

#include <vector>

#include "limit_project.h"

namespace {

struct Scene {
  int width, height;
  const int32_t *offsets, *ids;
  const Splat *splats;

  int across() const { return (width + TILE - 1) / TILE; }
  int tiles() const { return across() * ((height + TILE - 1) / TILE); }
  int left(int tile) const { return tile % across() * TILE; }
  int top(int tile) const { return tile / across() * TILE; }
};

// Walk one tile front to back; T receives the transmittance. sink.row(row, mask, weights, splat) gets alpha T of the
// pixels in mask, for every row a Gaussian reaches; sink.next(k, splat) follows the last row of fragment k.
template <class Sink> void walk(const Scene &scene, int tile, Lanes *T, Sink &sink) {
  const int left = scene.left(tile), top = scene.top(tile);
  const int columns = std::min(TILE, scene.width - left), rows = std::min(TILE, scene.height - top);
  const Lanes THRESHOLD = all(std::log2(ALPHA_MIN)), CLOSED = all(TRANSMITTANCE_MIN);
  Mask open[TILE];  // pixels of each row that have not closed
  for (int r = 0; r < TILE; r++) T[r] = all(1.0f), open[r] = (1u << columns) - 1;
  uint32_t open_rows = (1u << rows) - 1;
  const int end = scene.offsets[tile + 1];
  for (int k = scene.offsets[tile]; k < end && open_rows; k++) {
    if (k + 6 < end) __builtin_prefetch(&scene.splats[scene.ids[k + 6]]);
    const Splat &s = scene.splats[scene.ids[k]];
    const float x0 = left + 0.5f - s.x, y0 = top + 0.5f - s.y;
    const Lanes dy = IOTA + y0, edge = dy * dy * s.C + s.L, slope = dy * s.B;
    const Lanes best = smaller(larger(dy * s.ridge, all(x0)), all(x0 + (columns - 1)));
    const uint32_t reached = greater_equal((best * s.A + slope) * best + edge, THRESHOLD) & open_rows;
    if (!reached) continue;
    const Lanes dx = IOTA + x0, ramp = dx * s.A;
    alignas(64) float edges[16], slopes[16];
    store(edges, edge), store(slopes, slope);
    for (uint32_t left_over = reached; left_over; left_over &= left_over - 1) {
      const int r = __builtin_ctz(left_over);
      const Lanes e = (ramp + slopes[r]) * dx + edges[r];
      const Mask passed = greater_equal(e, THRESHOLD, open[r]);
      const Lanes weight = smaller(exp2(e), all(ALPHA_MAX)) * T[r], next = T[r] - weight;
      const Mask counts = greater(next, CLOSED, passed);
      sink.row(r, counts, masked(counts, weight), s);
      T[r] = select(counts, next, T[r]);
      if (passed != counts) {
        open[r] &= counts | ~passed;
        if (!open[r]) open_rows &= ~(1u << r);
      }
    }
    sink.next(k, s);
  }
}

// Three colours of a tile.
struct Colors {
  Lanes red[TILE], green[TILE], blue[TILE];
  Colors() { std::memset(this, 0, sizeof *this); }
  void row(int r, Mask, Lanes weight, const Splat &s) {
    red[r] += weight * s.r;
    green[r] += weight * s.g;
    blue[r] += weight * s.b;
  }
  void next(int, const Splat &) {}

  // To row-major images [H, W, 3] and [H, W].
  void write(const Scene &scene, int tile, const Lanes *T, float *rgb, float *alpha) const {
    const int left = scene.left(tile), top = scene.top(tile);
    const int columns = std::min(TILE, scene.width - left);
    for (int r = 0; r < TILE && top + r < scene.height; r++) {
      const size_t pixel = (size_t)(top + r) * scene.width + left;
      const Lanes color[3] = {red[r], green[r], blue[r]}, opacity = 1.0f - T[r];
      float values[3 * TILE];
      interleave<3>(color, values);
      std::memcpy(rgb + 3 * pixel, values, sizeof(float) * 3 * columns);
      std::memcpy(alpha + pixel, &opacity, sizeof(float) * columns);
    }
  }
};

// Colours for training: also which pixels take something of each fragment.
struct Recorded : Colors {
  uint16_t *rows;         // [I] rows of its tile in which a pixel takes something of each fragment
  std::vector<Mask> &masks;  // those pixels, row by row
  size_t used;
  uint32_t kept = 0;
  Recorded(const Scene &scene, int tile, uint16_t *rows, std::vector<Mask> &masks, size_t used)
      : rows(rows), masks(masks), used(used) {
    const int first = scene.offsets[tile];
    std::memset(rows + first, 0, sizeof(uint16_t) * (scene.offsets[tile + 1] - first));
    grow();
  }
  void grow() {
    if (used + TILE > masks.size()) masks.resize(2 * used + 65536);
  }
  void row(int r, Mask mask, Lanes weight, const Splat &s) {
    Colors::row(r, mask, weight, s);
    masks[used] = mask;
    used += mask != 0, kept |= (mask != 0) << r;
  }
  void next(int k, const Splat &) {
    rows[k] = kept, kept = 0;
    grow();
  }
};

// Sums that the backward pass of compositing adds up for every splat: g d^i under 1, dx, dy, dx^2, dx dy, dy^2 with
// g = dL / d log alpha and d = pixel - centre, then the gradient of the three colours.
constexpr int SUMS = 9;

// Replay one tile from its last fragment to its first. `kept` is the transmittance behind everything, `masks` ends with the
// tile's; v_rgb [H, W, 3], v_alpha [H, W]; totals [splats, 16] belongs to this thread. With c a fragment's colour under
// v_rgb and B the same of all behind it, dL / d log alpha = alpha T (c - B).
inline void walk_back(const Scene &scene, int tile, const Lanes *kept, const uint16_t *rows, const Mask *masks,
                      const float *v_rgb, const float *v_alpha, float *totals) {
  const int left = scene.left(tile), top = scene.top(tile), columns = std::min(TILE, scene.width - left);
  Lanes T[TILE], behind[TILE], v[TILE][3];
  for (int r = 0; r < TILE && top + r < scene.height; r++) {
    const size_t pixel = (size_t)(top + r) * scene.width + left;
    float values[3 * TILE] = {}, opacity[TILE] = {};
    std::memcpy(values, v_rgb + 3 * pixel, sizeof(float) * 3 * columns);
    std::memcpy(opacity, v_alpha + pixel, sizeof(float) * columns);
    deinterleave<3>(values, v[r]);
    behind[r] = -load(opacity), T[r] = kept[r];
  }
  const int first = scene.offsets[tile];
  for (int k = scene.offsets[tile + 1] - 1; k >= first; k--) {
    if (!rows[k]) continue;
    if (k - 6 >= first) {
      __builtin_prefetch(&scene.splats[scene.ids[k - 6]]);
      __builtin_prefetch(totals + (size_t)16 * scene.ids[k - 6], 1);
    }
    const Splat &s = scene.splats[scene.ids[k]];
    const float x0 = left + 0.5f - s.x, y0 = top + 0.5f - s.y;
    const Lanes dx = IOTA + x0, ramp = dx * s.A;
    Lanes g0 = {}, gy = {}, gyy = {}, red = {}, green = {}, blue = {};
    for (uint32_t left_over = rows[k]; left_over;) {
      const int r = 31 - __builtin_clz(left_over);
      left_over ^= 1u << r;
      const float dy = r + y0;
      const Lanes e = (ramp + dy * s.B) * dx + (dy * dy * s.C + s.L);
      const Mask counts = *--masks;
      const Lanes alpha = masked(counts, smaller(exp2(e), all(ALPHA_MAX)));
      T[r] *= reciprocal(1.0f - alpha);
      const Lanes weight = alpha * T[r];
      const Lanes excess = v[r][0] * s.r + v[r][1] * s.g + v[r][2] * s.b - behind[r];
      behind[r] += alpha * excess;
      red += weight * v[r][0], green += weight * v[r][1], blue += weight * v[r][2];
      const Lanes g = masked(greater(all(ALPHA_MAX), alpha, counts), weight * excess);
      g0 += g, gy += g * dy, gyy += g * (dy * dy);
    }
    const Lanes gx = g0 * dx;
    const Lanes parts[SUMS] = {g0, gx, gy, gx * dx, gy * dx, gyy, red, green, blue};
    float *total = totals + (size_t)16 * scene.ids[k];
    store(total, load(total) + sums<SUMS>(parts));
  }
}

}  // namespace
