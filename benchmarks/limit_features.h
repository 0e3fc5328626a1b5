// Compositing of feature vectors by hand, forward and backward: S slices of 16 channels.
//
// Fragments come in batches. For a row of 16 pixels, the weights of a batch are computed first; then they are
// multiplied by the features as small matrices are, 16 channels by 16 pixels in registers.
#pragma once

#include <atomic>

#include "limit_colors.h"

namespace {

// A fragment that a row takes something of: those pixels, its place in the batch. The end of a row is one more item,
// with the number of items before it, so that the list can be read from its end.
struct Item {
  uint16_t mask, fragment;
};

// Scratch of one thread.
template <int S> struct FeatureScratch {
  Batch batch;
  Lanes image[TILE][16 * S];  // channels of the rows, or their gradients
  Lanes weights[Batch::SIZE], values[Batch::SIZE + 4], moments[Batch::SIZE][3], gradients[Batch::SIZE][S];
};

// [pixel][channel] of a row of the image to [channel][pixel] and back; `columns` pixels lie inside.
template <int S> inline void read_row(const float *from, int columns, Lanes *to) {
  for (int s = 0; s < S; s++) {
    for (int i = 0; i < 16; i++) to[16 * s + i] = load_if(i < columns, from + 16 * (S * i + s));
    transpose(to + 16 * s);
  }
}
template <int S> inline void write_row(Lanes *from, int columns, float *to) {
  for (int s = 0; s < S; s++) {
    transpose(from + 16 * s);
    for (int i = 0; i < columns; i++) store(to + 16 * (S * i + s), from[16 * s + i]);
  }
}

// The features of a batch are fetched while its first weights are computed.
template <int S> inline void prefetch_features(const Batch &batch, const float *features) {
  for (int b = 0; b < batch.count; b++)
    for (int s = 0; s < S; s++) __builtin_prefetch(features + 16 * ((size_t)S * batch.splats[b]->gaussian + s));
}

// Returns how many batches were looked at; T receives the transmittance, `items` what the backward pass replays.
template <int S>
int composite_features(const Scene &scene, int tile, const float *features, FeatureScratch<S> &scratch, Lanes *T,
                       std::vector<Item> &items, size_t &used, float *image, float *alpha) {
  const int left = scene.left(tile), top = scene.top(tile);
  const int columns = std::min(TILE, scene.width - left), rows = std::min(TILE, scene.height - top);
  const Lanes THRESHOLD = all(std::log2(ALPHA_MIN)), CLOSED = all(TRANSMITTANCE_MIN);
  Batch &batch = scratch.batch;
  for (int r = 0; r < rows; r++) T[r] = select((1u << columns) - 1, all(1.0f), all(-1.0f));
  std::memset(scratch.image, 0, sizeof scratch.image);
  int batches = 0;
  uint32_t open = (1u << rows) - 1;
  for (int first = scene.offsets[tile]; first < scene.offsets[tile + 1] && open; first += Batch::SIZE, batches++) {
    batch.read(scene, tile, first);
    prefetch_features<S>(batch, features);
    if (used + TILE * (Batch::SIZE + 1) > items.size()) items.resize(2 * used + 65536);
    for (int r = 0; r < rows; r++) {
      Item *item = &items[used];
      Lanes t = T[r];
      int n = 0;
      for (uint32_t reaching = open >> r & 1 ? having(batch.rows, r) : 0; reaching; reaching &= reaching - 1) {
        const int b = __builtin_ctz(reaching);
        const Lanes e = batch.exponent(b, r);
        const Mask passed = greater_equal(e, THRESHOLD);
        const Lanes weight = smaller(exp2(e), all(ALPHA_MAX)) * t, next = t - weight;
        const Mask counts = greater(next, CLOSED, passed);
        scratch.weights[n] = masked(counts, weight), item[n] = {counts, (uint16_t)b};
        n += counts != 0;
        t = select(counts, next, select(passed, negative(t), t));
      }
      T[r] = t;
      if (!greater(t, Lanes{}, 0xffff)) open &= ~(1u << r);
      item[n] = {(uint16_t)n, 0};
      used += n + 1;
      for (int s = 0; s < S; s++) {
        Lanes sum[16], *kept = scratch.image[r] + 16 * s;
        for (int c = 0; c < 16; c++) sum[c] = kept[c];
        for (int i = 0; i < n; i++) {
          const int gaussian = batch.splats[item[i].fragment]->gaussian;
          const float *x = features + (size_t)16 * S * gaussian + 16 * s;
          const Lanes weight = scratch.weights[i];
          for (int c = 0; c < 16; c++) sum[c] += weight * x[c];
        }
        for (int c = 0; c < 16; c++) kept[c] = sum[c];
      }
    }
  }
  for (int r = 0; r < rows; r++) {
    const size_t pixel = (size_t)(top + r) * scene.width + left;
    T[r] = -negative(T[r]);
    const Lanes opacity = 1.0f - T[r];
    write_row<S>(scratch.image[r], columns, image + 16 * S * pixel);
    std::memcpy(alpha + pixel, &opacity, sizeof(float) * columns);
  }
  return batches;
}

// Replay a tile from its last batch; `items` ends with the tile's. v_features [N, 16 S] is shared: a lock per splat.
template <int S>
void composite_features_back(const Scene &scene, int tile, int batches, const Lanes *kept, const Item *items,
                             const float *features, const float *v_image, const float *v_alpha,
                             FeatureScratch<S> &scratch, float *totals, float *v_features, std::atomic_flag *locks) {
  const int left = scene.left(tile), top = scene.top(tile), columns = std::min(TILE, scene.width - left);
  const int rows = std::min(TILE, scene.height - top);
  Batch &batch = scratch.batch;
  Lanes T[TILE], behind[TILE];
  for (int r = 0; r < rows; r++) {
    const size_t pixel = (size_t)(top + r) * scene.width + left;
    float opacity[TILE] = {};
    std::memcpy(opacity, v_alpha + pixel, sizeof(float) * columns);
    behind[r] = -load(opacity), T[r] = kept[r];
    read_row<S>(v_image + 16 * S * pixel, columns, scratch.image[r]);
  }
  const auto feature = [&](const Item &item) {
    return features + (size_t)16 * S * batch.splats[item.fragment]->gaussian;
  };
  while (batches--) {
    batch.read(scene, tile, scene.offsets[tile] + Batch::SIZE * batches);
    prefetch_features<S>(batch, features);
    std::memset(scratch.moments, 0, sizeof scratch.moments);
    std::memset(scratch.gradients, 0, sizeof scratch.gradients);
    uint32_t touched = 0;
    for (int r = rows - 1; r >= 0; r--) {
      const int n = (--items)->mask;
      items -= n;
      for (int i = 0; i < n; i += 4) {  // features under the image's gradient, four fragments at a time
        const float *x[4];
        Lanes value[4] = {};
        for (int j = 0; j < 4; j++) x[j] = feature(items[std::min(i + j, n - 1)]);
        for (int c = 0; c < 16 * S; c++)
          for (int j = 0; j < 4; j++) value[j] += scratch.image[r][c] * x[j][c];
        for (int j = 0; j < 4; j++) scratch.values[i + j] = value[j];
      }
      for (int i = n - 1; i >= 0; i--) {
        const int b = items[i].fragment;
        const float dy = r + batch.y0[b];
        const Lanes alpha = masked(items[i].mask, smaller(exp2(batch.exponent(b, r)), all(ALPHA_MAX)));
        T[r] *= reciprocal(1.0f - alpha);
        const Lanes weight = alpha * T[r], excess = scratch.values[i] - behind[r];
        behind[r] += alpha * excess;
        scratch.weights[i] = weight;
        const Lanes g = masked(greater(all(ALPHA_MAX), alpha, items[i].mask), weight * excess);
        Lanes *moments = scratch.moments[b];
        moments[0] += g, moments[1] += g * dy, moments[2] += g * (dy * dy);
        touched |= 1u << b;
      }
      const float *pixels = v_image + 16 * S * ((size_t)(top + r) * scene.width + left);
      for (int i = 0; i < n; i++) {
        Lanes sum[S], *gradient = scratch.gradients[items[i].fragment];
        const Lanes &weights = scratch.weights[i];
        for (int s = 0; s < S; s++) sum[s] = gradient[s];
        if (S == 1 && columns == TILE) {  // one vector a pixel: all of them are faster than finding out which
          Lanes parts[4] = {sum[0]};
          for (int p = 0; p < TILE; p++) parts[p % 4] += weights[p] * load(pixels + 16 * p);
          sum[0] = (parts[0] + parts[1]) + (parts[2] + parts[3]);
        } else {
          for (uint32_t left_over = items[i].mask; left_over; left_over &= left_over - 1) {
            const int p = __builtin_ctz(left_over);
            for (int s = 0; s < S; s++) sum[s] += weights[p] * load(pixels + 16 * (S * p + s));
          }
        }
        for (int s = 0; s < S; s++) gradient[s] = sum[s];
      }
    }
    for (; touched; touched &= touched - 1) {
      const int b = __builtin_ctz(touched), id = batch.ids[b];
      const Lanes *g = scratch.moments[b], dx = batch.dx[b], gx = g[0] * dx;
      const Lanes parts[6] = {g[0], gx, g[1], gx * dx, g[1] * dx, g[2]};
      float *total = totals + (size_t)16 * id, *to = v_features + (size_t)16 * S * batch.splats[b]->gaussian;
      store(total, load(total) + sums<6>(parts));
      while (locks[id].test_and_set(std::memory_order_acquire)) {}
      for (int s = 0; s < S; s++) store(to + 16 * s, load(to + 16 * s) + scratch.gradients[b][s]);
      locks[id].clear(std::memory_order_release);
    }
  }
}

}  // namespace
