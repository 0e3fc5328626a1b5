// Compositing of three colours by hand, forward and backward: 16 pixels of a row at a time, a thread per 16 x 16 tile.
//
// Forward, fragments come in batches: one vector operation over the 16 rows of the tile finds the rows that a fragment
// reaches; then each row takes its fragments of the batch one after the other, its state in registers. Backward,
// fragments come one at a time, from the last, so that their sums over the rows are in registers.
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

// Which pixels take something of each fragment, for the backward pass.
struct Record {
  uint16_t *rows;            // [I] rows in which a pixel does
  std::vector<Mask> &masks;  // those pixels, fragment by fragment, row by row
  size_t used;               // masks
};

// Fragments as their tile sees them: the exponent at pixel (r, c) is (ramp + slopes[r]) dx + edges[r].
struct Batch {
  static constexpr int SIZE = 32;
  int count;
  Lanes dx[SIZE], ramp[SIZE];
  alignas(64) float edges[SIZE][16], slopes[SIZE][16];
  alignas(64) uint16_t rows[SIZE];  // that it reaches
  const Splat *splats[SIZE];
  int32_t ids[SIZE];
  float y0[SIZE];

  void read(const Scene &scene, int tile, int first) {
    const int left = scene.left(tile), top = scene.top(tile), columns = std::min(TILE, scene.width - left);
    const int end = scene.offsets[tile + 1];
    count = std::min(SIZE, end - first);
    std::memset(rows, 0, sizeof rows);
    for (int b = 0; b < count; b++) {
      if (first + b + 8 < end) __builtin_prefetch(&scene.splats[scene.ids[first + b + 8]]);
      ids[b] = scene.ids[first + b];
      const Splat &s = scene.splats[ids[b]];
      splats[b] = &s;
      const float x0 = left + 0.5f - s.x;
      y0[b] = top + 0.5f - s.y;
      const Lanes dy = IOTA + y0[b], edge = dy * dy * s.C + s.L, slope = dy * s.B;
      const Lanes best = smaller(larger(dy * s.ridge, all(x0)), all(x0 + (columns - 1)));
      rows[b] = greater_equal((best * s.A + slope) * best + edge, all(std::log2(ALPHA_MIN)));
      dx[b] = IOTA + x0, ramp[b] = dx[b] * s.A;
      store(edges[b], edge), store(slopes[b], slope);
    }
  }
  Lanes exponent(int b, int row) const { return (ramp[b] + slopes[b][row]) * dx[b] + edges[b][row]; }
};

// Three colours of one tile, a row of pixels at a time with its state in registers; to row-major images [H, W, 3] and
// [H, W]. T receives the transmittance, `record` what the backward pass replays, unless it is null. Until then a pixel
// that has closed keeps its transmittance with a negative sign: nothing can pass the test any more.
inline void composite_colors(const Scene &scene, int tile, Lanes *T, Record *record, float *rgb, float *alpha) {
  const int left = scene.left(tile), top = scene.top(tile);
  const int columns = std::min(TILE, scene.width - left), rows = std::min(TILE, scene.height - top);
  const int begin = scene.offsets[tile], end = scene.offsets[tile + 1];
  const Lanes THRESHOLD = all(std::log2(ALPHA_MIN)), CLOSED = all(TRANSMITTANCE_MIN);
  Lanes color[TILE][3] = {};
  alignas(64) Mask taken[Batch::SIZE][TILE];
  Batch batch;
  for (int r = 0; r < rows; r++) T[r] = select((1u << columns) - 1, all(1.0f), all(-1.0f));
  if (record) std::memset(record->rows + begin, 0, sizeof(uint16_t) * (end - begin));
  uint32_t open = (1u << rows) - 1;
  for (int first = begin; first < end && open; first += Batch::SIZE) {
    batch.read(scene, tile, first);
    std::memset(taken, 0, sizeof taken);
    for (uint32_t left_over = open; left_over; left_over &= left_over - 1) {
      const int r = __builtin_ctz(left_over);
      Lanes t = T[r], red = color[r][0], green = color[r][1], blue = color[r][2];
      for (uint32_t reaching = having(batch.rows, r); reaching; reaching &= reaching - 1) {
        const int b = __builtin_ctz(reaching);
        const Splat &s = *batch.splats[b];
        const Lanes e = batch.exponent(b, r);
        const Mask passed = greater_equal(e, THRESHOLD);
        Lanes weight = smaller(exp2(e), all(ALPHA_MAX)) * t;
        const Lanes next = t - weight;
        const Mask counts = greater(next, CLOSED, passed);
        weight = masked(counts, weight);
        red += weight * s.r, green += weight * s.g, blue += weight * s.b;
        t = select(counts, next, select(passed, negative(t), t));
        taken[b][r] = counts;
      }
      T[r] = t, color[r][0] = red, color[r][1] = green, color[r][2] = blue;
      if (!greater(t, Lanes{}, 0xffff)) open &= ~(1u << r);
    }
    if (!record) continue;
    if (record->used + TILE * Batch::SIZE > record->masks.size()) record->masks.resize(2 * record->used + 65536);
    for (int b = 0; b < batch.count; b++) {
      record->rows[first + b] = nonzero(taken[b]);
      record->used += compress(taken[b], &record->masks[record->used]);
    }
  }
  for (int r = 0; r < rows; r++) {
    const size_t pixel = (size_t)(top + r) * scene.width + left;
    T[r] = -negative(T[r]);
    const Lanes opacity = 1.0f - T[r];
    float values[3 * TILE];
    interleave<3>(color[r], values);
    std::memcpy(rgb + 3 * pixel, values, sizeof(float) * 3 * columns);
    std::memcpy(alpha + pixel, &opacity, sizeof(float) * columns);
  }
}

// Sums that the backward pass of compositing adds up for every splat: g d^i under 1, dx, dy, dx^2, dx dy, dy^2 with
// g = dL / d log alpha and d = pixel - centre, then the gradient of the three colours.
constexpr int SUMS = 9;

// Replay one tile from its last fragment to its first. `kept` is the transmittance behind everything, `masks` ends with
// the tile's; v_rgb [H, W, 3], v_alpha [H, W]; totals [splats, 16] belongs to this thread. With c a fragment's colour
// under v_rgb and B the same of all behind it, dL / d log alpha = alpha T (c - B).
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
