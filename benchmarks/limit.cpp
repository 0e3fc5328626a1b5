// The limit the kernels are compared with: compositing and lifting of given tile lists, by hand, OpenMP over tiles.
#include <atomic>
#include <vector>

#include <omp.h>

#include "limit_colors.h"

namespace {

// Splats from what projection leaves; the memory stays, so that only the first call pays for its pages.
const Splat *splats_of(int n, const float *mean2d, const float *conic, const float *opacity, const float *color,
                       int threads) {
  static std::vector<Splat> splats;
  if (splats.size() < (size_t)n) splats.resize(n);
#pragma omp parallel for num_threads(threads)
  for (int i = 0; i < n; i++) {
    float a = conic[3 * i], b = conic[3 * i + 1], c = conic[3 * i + 2];
    Splat &s = splats[i];
    s.x = mean2d[2 * i], s.y = mean2d[2 * i + 1];
    s.A = -0.5f * LOG2E * a, s.B = -LOG2E * b, s.C = -0.5f * LOG2E * c, s.L = std::log2(opacity[i]);
    s.ridge = -b / a;
    if (color) s.r = color[3 * i], s.g = color[3 * i + 1], s.b = color[3 * i + 2];
  }
  return splats.data();
}

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

// Sums weights under each id of a tile: one accumulator of 16 lanes per id present, reduced once per Gaussian.
struct Ids {
  int count = 0, names[TILE * TILE];  // ids present in the tile
  struct Part { Mask mask; int16_t local; } parts[TILE * TILE];
  int first[TILE + 1];  // parts of each row
  Lanes sums[TILE * TILE];
  uint64_t touched[TILE * TILE / 64] = {};
  const int32_t *ids;
  int channels;
  float *features;

  Ids(const Scene &scene, int tile, const int32_t *image, int channels, float *features)
      : ids(scene.ids), channels(channels), features(features) {
    const int left = scene.left(tile), top = scene.top(tile);
    int parts_used = 0;
    for (int r = 0; r < TILE; r++) {
      first[r] = parts_used;
      for (int c = 0; c < TILE && left + c < scene.width && top + r < scene.height; c++) {
        const int id = image[(size_t)(top + r) * scene.width + left + c];
        if (id < 0) continue;
        int local = 0, part = first[r];
        while (local < count && names[local] != id) local++;
        if (local == count) names[count] = id, sums[count++] = Lanes{};
        while (part < parts_used && parts[part].local != local) part++;
        if (part == parts_used) parts[parts_used++] = {0, (int16_t)local};
        parts[part].mask |= 1u << c;
      }
    }
    first[TILE] = parts_used;
  }
  void row(int r, Mask, Lanes weight, const Splat &) {
    for (int p = first[r]; p < first[r + 1]; p++) {
      const int local = parts[p].local;
      sums[local] += masked(parts[p].mask, weight);
      touched[local / 64] |= uint64_t(1) << local % 64;
    }
  }
  void next(int k, const Splat &) {
    const int gaussian = ids[k];
    for (int word = 0; word * 64 < count; word++)
      for (; touched[word]; touched[word] &= touched[word] - 1) {
        const int local = word * 64 + __builtin_ctzll(touched[word]);
        float &total = features[(size_t)gaussian * channels + names[local]];
        const float value = sum(sums[local]);
        sums[local] = Lanes{};
#pragma omp atomic
        total += value;
      }
  }
};

// The K largest weights of each pixel, place by place, 16 pixels of a row in a vector.
struct Ranks {
  const Splat *splats;
  int places, used[TILE] = {};
  Lanes *weights;  // [row][place]
  Ints *owners;

  void row(int r, Mask, Lanes weight, const Splat &s) {
    Lanes *w = weights + r * places;
    Ints *of = owners + r * places;
    int place = std::min(used[r], places - 1);
    if (!greater(weight, w[place], 0xffff)) return;
    used[r] = place + 1;
    const Ints mine = Ints{} + int32_t(&s - splats);
    for (; place > 0; place--) {
      const Ints moves = weight > w[place - 1], enters = weight > w[place];
      w[place] = moves ? w[place - 1] : enters ? weight : w[place];
      of[place] = moves ? of[place - 1] : enters ? mine : of[place];
      if (!greater(weight, w[place - 1], 0xffff)) return;
    }
    const Ints enters = weight > w[0];
    w[0] = enters ? weight : w[0];
    of[0] = enters ? mine : of[0];
  }
  void next(int, const Splat &) {}
};

// The pairs of a tile, Gaussian by Gaussian: pixel and weight.
struct Pairs {
  const int32_t *ids;
  std::vector<int> gaussians, ends;
  std::vector<float> weights;
  std::vector<uint8_t> pixels;
  int used = 0;

  void clear() { gaussians.clear(), ends.clear(), used = 0; }
  void row(int r, Mask counts, Lanes weight, const Splat &) {
    if ((size_t)used + 256 > weights.size()) weights.resize(2 * used + 65536), pixels.resize(2 * used + 65536);
    used += compress(counts, weight, r * TILE, &weights[used], &pixels[used]);
  }
  void next(int k, const Splat &) { gaussians.push_back(ids[k]), ends.push_back(used); }
};

// One slice of 16 V channels: sums[i] = sum over the pairs of Gaussian i of weight * slice[pixel], first <= i < last.
// Two sets of registers hide the latency of the additions.
template <int V>
void multiply(const Pairs &pairs, size_t first, size_t last, const Lanes *slice, Lanes *sums, int stride) {
  for (size_t i = first, p = first ? pairs.ends[first - 1] : 0; i < last; i++, sums += stride) {
    const size_t end = pairs.ends[i];
    Lanes even[V] = {}, odd[V] = {};
    for (; p + 1 < end; p += 2) {
      const Lanes *f0 = slice + V * pairs.pixels[p], *f1 = slice + V * pairs.pixels[p + 1];
      for (int v = 0; v < V; v++) even[v] += f0[v] * pairs.weights[p], odd[v] += f1[v] * pairs.weights[p + 1];
    }
    if (p < end)
      for (int v = 0; v < V; v++) even[v] += slice[V * pairs.pixels[p] + v] * pairs.weights[p];
    for (int v = 0; v < V; v++) sums[v] = even[v] + odd[v];
    p = end;
  }
}

}  // namespace

// Returns the seconds that compositing takes once the splats are packed, as they are in the package.
extern "C" double composite(int n, const float *mean2d, const float *conic, const float *opacity, const float *color,
                            int width, int height, const int32_t *offsets, const int32_t *ids, int threads,
                            float *rgb, float *alpha) {
  const Scene scene = {width, height, offsets, ids, splats_of(n, mean2d, conic, opacity, color, threads)};
  const double start = omp_get_wtime();
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads)
  for (int tile = 0; tile < scene.tiles(); tile++) {
    Lanes T[TILE];
    composite_colors(scene, tile, T, nullptr, rgb, alpha);
  }
  return omp_get_wtime() - start;
}

// image [H, W] holds ids below channels, -1 for none; features [n, channels] is added to.
extern "C" void lift_ids(int n, const float *mean2d, const float *conic, const float *opacity, int width, int height,
                         const int32_t *offsets, const int32_t *ids, int threads, const int32_t *image, int channels,
                         float *features) {
  const Scene scene = {width, height, offsets, ids, splats_of(n, mean2d, conic, opacity, nullptr, threads)};
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads)
  for (int tile = 0; tile < scene.tiles(); tile++) {
    Lanes T[TILE];
    Ids sink(scene, tile, image, channels, features);
    walk(scene, tile, T, sink);
  }
}

// ids_out and weights_out [H, W, places]; -1 and 0 where there are no more.
extern "C" void rank(int n, const float *mean2d, const float *conic, const float *opacity, int width, int height,
                     const int32_t *offsets, const int32_t *ids, int threads, int places, int32_t *ids_out,
                     float *weights_out) {
  const Scene scene = {width, height, offsets, ids, splats_of(n, mean2d, conic, opacity, nullptr, threads)};
#pragma omp parallel num_threads(threads)
  {
    std::vector<Lanes> weights(TILE * places);
    std::vector<Ints> owners(TILE * places);
#pragma omp for schedule(dynamic, 4)
    for (int tile = 0; tile < scene.tiles(); tile++) {
      std::fill(weights.begin(), weights.end(), Lanes{});
      std::fill(owners.begin(), owners.end(), Ints{} - 1);
      Lanes T[TILE];
      Ranks sink = {scene.splats, places};
      sink.weights = weights.data(), sink.owners = owners.data();
      walk(scene, tile, T, sink);
      const int left = scene.left(tile), top = scene.top(tile);
      for (int r = 0; r < TILE && top + r < height; r++)
        for (int c = 0; c < TILE && left + c < width; c++)
          for (int place = 0; place < places; place++) {
            const size_t to = ((size_t)(top + r) * width + left + c) * places + place;
            weights_out[to] = ((const float *)&weights[r * places + place])[c];
            ids_out[to] = ((const int32_t *)&owners[r * places + place])[c];
          }
    }
  }
}

// image [H, W, channels]; features [n, channels] and weight [n] are added to.
extern "C" void lift_dense(int n, const float *mean2d, const float *conic, const float *opacity, int width, int height,
                           const int32_t *offsets, const int32_t *ids, int threads, const float *image, int channels,
                           float *features, float *weight) {
  const Scene scene = {width, height, offsets, ids, splats_of(n, mean2d, conic, opacity, nullptr, threads)};
  std::vector<std::atomic_flag> locks(n);
#pragma omp parallel num_threads(threads)
  {
    const int GROUP = 32;  // Gaussians whose sums stay in L2 while the slices pass
    Pairs pairs = {ids};
    const int padded = (channels + 63) / 64 * 64;
    std::vector<Lanes> sums(GROUP * padded / 16);
    std::vector<Lanes> slices(TILE * TILE * padded / 16);  // [slice][pixel][4 Lanes], fewer Lanes in the last slice
#pragma omp for schedule(dynamic, 4)
    for (int tile = 0; tile < scene.tiles(); tile++) {
      const int left = scene.left(tile), top = scene.top(tile);
      Lanes T[TILE];
      pairs.clear();
      walk(scene, tile, T, pairs);
      const int rest = (channels - 1) % 64 + 1, last = rest > 32 ? 4 : rest > 16 ? 2 : 1;
      for (int r = 0; r < TILE && top + r < height; r++)
        for (int c = 0; c < TILE && left + c < width; c++) {
          const float *pixel = image + ((size_t)(top + r) * width + left + c) * channels;
          for (int from = 0; from < channels; from += 64) {
            const int V = from + 64 < channels ? 4 : last;
            std::memcpy(&slices[from * 16 + V * (r * TILE + c)], pixel + from, std::min(64, channels - from) * 4);
          }
        }
      for (size_t begin = 0; begin < pairs.ends.size(); begin += GROUP) {
        const size_t end = std::min(begin + GROUP, pairs.ends.size());
        for (int from = 0; from < channels; from += 64) {
          const int V = from + 64 < channels ? 4 : last;
          const auto product = V == 4 ? multiply<4> : V == 2 ? multiply<2> : multiply<1>;
          product(pairs, begin, end, &slices[from * 16], &sums[from / 16], padded / 16);
        }
        for (size_t i = begin, p = begin ? pairs.ends[begin - 1] : 0; i < end; i++) {
          const int gaussian = pairs.gaussians[i];
          const float *from = (const float *)&sums[(i - begin) * padded / 16];
          float *to = features + (size_t)gaussian * channels, total = 0;
          for (; p < (size_t)pairs.ends[i]; p++) total += pairs.weights[p];
          if (i + 1 < end)
            for (int c = 0; c < channels; c += 16)
              __builtin_prefetch(features + (size_t)pairs.gaussians[i + 1] * channels + c, 1);
          while (locks[gaussian].test_and_set(std::memory_order_acquire)) {}
          for (int c = 0; c < channels; c++) to[c] += from[c];
          weight[gaussian] += total;
          locks[gaussian].clear(std::memory_order_release);
        }
      }
    }
  }
}
