// The limit the kernels are compared with: compositing and lifting by hand, 16-lane rows, OpenMP over tiles.
//
// A thread owns a 16 x 16 tile. Its list of Gaussians comes front to back. For each of them one vector operation over
// the 16 rows finds the rows it reaches; those rows are composited 16 pixels at a time, their state being in L1.
// A pixel that closes keeps its transmittance with a negative sign: nothing can pass the test any more.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include <omp.h>
#ifdef __AVX512F__
#include <immintrin.h>
#endif

namespace {

constexpr int TILE = 16;
constexpr float ALPHA_MIN = 1.0f / 255.0f, ALPHA_MAX = 0.999f, TRANSMITTANCE_MIN = 1e-4f;

typedef float Lanes __attribute__((vector_size(64)));  // 16 pixels of a row, or 16 rows of a tile
typedef uint16_t Mask;                                 // one bit per lane

const Lanes IOTA = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

inline Lanes all(float value) { return Lanes{} + value; }

#ifdef __AVX512F__
inline Mask greater_equal(Lanes a, Lanes b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }
inline Mask greater(Lanes a, Lanes b, Mask where) { return _mm512_mask_cmp_ps_mask(where, a, b, _CMP_GT_OQ); }
inline Lanes select(Mask mask, Lanes yes, Lanes no) { return _mm512_mask_blend_ps(mask, no, yes); }
inline Lanes masked(Mask mask, Lanes value) { return _mm512_maskz_mov_ps(mask, value); }
inline Lanes smaller(Lanes a, Lanes b) { return _mm512_min_ps(a, b); }
inline Lanes larger(Lanes a, Lanes b) { return _mm512_max_ps(a, b); }
inline float sum(Lanes a) { return _mm512_reduce_add_ps(a); }
// Append the lanes in mask, and their indices counted from base; returns how many. Writes up to 16 of each.
inline int compress(Mask mask, Lanes value, int base, float *values, uint8_t *indices) {
  _mm512_storeu_ps(values, _mm512_maskz_compress_ps(mask, value));
  const __m512i lanes = _mm512_add_epi32(_mm512_cvtps_epi32(IOTA), _mm512_set1_epi32(base));
  _mm_storeu_si128((__m128i *)indices, _mm512_cvtepi32_epi8(_mm512_maskz_compress_epi32(mask, lanes)));
  return __builtin_popcount(mask);
}
inline Lanes fraction(Lanes x) { return _mm512_reduce_ps(x, 0); }
inline Lanes scale(Lanes mantissa, Lanes x) { return _mm512_scalef_ps(mantissa, _mm512_roundscale_ps(x, 0)); }
#else
template <class F> inline Mask bits(F test) {
  Mask mask = 0;
  for (int i = 0; i < 16; i++) mask |= test(i) << i;
  return mask;
}
template <class F> inline Lanes lanes(F value) {
  Lanes result;
#pragma omp simd
  for (int i = 0; i < 16; i++) result[i] = value(i);
  return result;
}
inline Mask greater_equal(Lanes a, Lanes b) { return bits([&](int i) { return a[i] >= b[i]; }); }
inline Mask greater(Lanes a, Lanes b, Mask where) { return where & bits([&](int i) { return a[i] > b[i]; }); }
inline Lanes select(Mask m, Lanes yes, Lanes no) { return lanes([&](int i) { return m >> i & 1 ? yes[i] : no[i]; }); }
inline Lanes masked(Mask mask, Lanes value) { return select(mask, value, Lanes{}); }
inline Lanes smaller(Lanes a, Lanes b) { return lanes([&](int i) { return a[i] < b[i] ? a[i] : b[i]; }); }
inline Lanes larger(Lanes a, Lanes b) { return lanes([&](int i) { return a[i] > b[i] ? a[i] : b[i]; }); }
inline float sum(Lanes a) {
  float total = 0;
  for (int i = 0; i < 16; i++) total += a[i];
  return total;
}
inline int compress(Mask mask, Lanes value, int base, float *values, uint8_t *indices) {
  int count = 0;
  for (int i = 0; i < 16; i++)
    if (mask >> i & 1) values[count] = value[i], indices[count++] = base + i;
  return count;
}
inline Lanes fraction(Lanes x) { return lanes([&](int i) { return x[i] - std::nearbyint(x[i]); }); }
inline Lanes scale(Lanes mantissa, Lanes x) {
  return lanes([&](int i) { return std::ldexp(mantissa[i], (int)std::nearbyint(x[i])); });
}
#endif

// 2^x to 2e-7 relative: x is split at the nearest integer, the rest goes into the minimax polynomial of degree 5.
inline Lanes exp2(Lanes x) {
  Lanes f = fraction(x);
  Lanes p = all(1.327647245e-3f) * f + 9.675540961e-3f;
  p = p * f + 5.550713092e-2f;
  p = p * f + 2.402212024e-1f;
  p = p * f + 6.931469440e-1f;
  p = p * f + 1.000000119f;
  return scale(p, x);
}

struct alignas(64) Splat {
  float x, y;        // centre [pixels]
  float A, B, C, L;  // log2 alpha = A dx^2 + B dx dy + C dy^2 + L
  float ridge;       // dx of the largest alpha on a row, over dy
  float r, g, b;
};

struct Scene {
  int width, height;
  const int32_t *offsets, *ids;
  std::vector<Splat> splats;

  Scene(int n, const float *mean2d, const float *conic, const float *opacity, const float *color, int width, int height,
        const int32_t *offsets, const int32_t *ids, int threads)
      : width(width), height(height), offsets(offsets), ids(ids), splats(n) {
    const float LOG2E = 1.44269504f;
#pragma omp parallel for num_threads(threads)
    for (int i = 0; i < n; i++) {
      float a = conic[3 * i], b = conic[3 * i + 1], c = conic[3 * i + 2];
      Splat &s = splats[i];
      s.x = mean2d[2 * i], s.y = mean2d[2 * i + 1];
      s.A = -0.5f * LOG2E * a, s.B = -LOG2E * b, s.C = -0.5f * LOG2E * c, s.L = std::log2(opacity[i]);
      s.ridge = -b / a;
      if (color) s.r = color[3 * i], s.g = color[3 * i + 1], s.b = color[3 * i + 2];
    }
  }
  int across() const { return (width + TILE - 1) / TILE; }
  int tiles() const { return across() * ((height + TILE - 1) / TILE); }
};

// Walk one tile front to back. sink.row(row, mask, weights, splat) gets alpha T of the pixels in mask, for every
// row a Gaussian reaches; sink.next(gaussian, splat) follows its last row.
template <class Sink> void walk(const Scene &scene, int tile, Lanes *T, Sink &sink) {
  const int left = tile % scene.across() * TILE, top = tile / scene.across() * TILE;
  const int columns = std::min(TILE, scene.width - left), rows = std::min(TILE, scene.height - top);
  const Lanes THRESHOLD = all(std::log2(ALPHA_MIN)), CLOSED = all(TRANSMITTANCE_MIN);
  const Lanes start = select((1u << columns) - 1, all(1.0f), all(-1.0f));
  for (int r = 0; r < TILE; r++) T[r] = start;
  uint32_t open = (1u << rows) - 1;
  const int end = scene.offsets[tile + 1];
  for (int k = scene.offsets[tile]; k < end && open; k++) {
    if (k + 6 < end) __builtin_prefetch(&scene.splats[scene.ids[k + 6]]);
    const Splat &s = scene.splats[scene.ids[k]];
    const float x0 = left + 0.5f - s.x, y0 = top + 0.5f - s.y;
    const Lanes dy = IOTA + y0, edge = dy * dy * s.C + s.L, slope = dy * s.B;
    const Lanes best = smaller(larger(dy * s.ridge, all(x0)), all(x0 + (columns - 1)));
    uint32_t reached = greater_equal((best * s.A + slope) * best + edge, THRESHOLD) & open;
    if (!reached) continue;
    const Lanes dx = IOTA + x0, ramp = dx * s.A;
    alignas(64) float edges[16], slopes[16];
    std::memcpy(edges, &edge, 64), std::memcpy(slopes, &slope, 64);
    for (uint32_t left_over = reached; left_over; left_over &= left_over - 1) {
      const int r = __builtin_ctz(left_over);
      const Lanes e = (ramp + slopes[r]) * dx + edges[r];
      const Mask passed = greater_equal(e, THRESHOLD);
      const Lanes alpha = smaller(exp2(e), all(ALPHA_MAX));
      const Lanes weight = alpha * T[r], next = T[r] - weight;
      const Mask counts = greater(next, CLOSED, passed);
      const Mask closes = passed & ~counts;
      sink.row(r, counts, masked(counts, weight), s);
      T[r] = select(counts, next, T[r]);
      if (closes) {
        T[r] = select(closes, smaller(T[r], -T[r]), T[r]);
        if (!greater(T[r], Lanes{}, 0xffff)) open &= ~(1u << r);
      }
    }
    sink.next(scene.ids[k], s);
  }
}

struct Colors {
  Lanes red[TILE], green[TILE], blue[TILE];
  Colors() { std::memset(this, 0, sizeof *this); }
  void row(int r, Mask, Lanes weight, const Splat &s) {
    red[r] += weight * s.r;
    green[r] += weight * s.g;
    blue[r] += weight * s.b;
  }
  void next(int, const Splat &) {}
};

// Sums weights under each id of a tile: one accumulator of 16 lanes per id present, reduced once per Gaussian.
struct Ids {
  int count = 0, names[TILE * TILE];  // ids present in the tile
  struct Part { Mask mask; int16_t local; } parts[TILE * TILE];
  int first[TILE + 1];  // parts of each row
  Lanes sums[TILE * TILE];
  uint64_t touched[TILE * TILE / 64] = {};
  int channels;
  float *features;

  Ids(const Scene &scene, int tile, const int32_t *image, int channels, float *features)
      : channels(channels), features(features) {
    const int left = tile % scene.across() * TILE, top = tile / scene.across() * TILE;
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
  void next(int gaussian, const Splat &) {
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

// The pairs of a tile, Gaussian by Gaussian: pixel and weight.
struct Pairs {
  std::vector<int> gaussians, ends;
  std::vector<float> weights;
  std::vector<uint8_t> pixels;
  int used = 0;

  void clear() { gaussians.clear(), ends.clear(), used = 0; }
  void row(int r, Mask counts, Lanes weight, const Splat &) {
    if ((size_t)used + 256 > weights.size()) weights.resize(2 * used + 65536), pixels.resize(2 * used + 65536);
    used += compress(counts, weight, r * TILE, &weights[used], &pixels[used]);
  }
  void next(int gaussian, const Splat &) { gaussians.push_back(gaussian), ends.push_back(used); }
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

extern "C" void composite(int n, const float *mean2d, const float *conic, const float *opacity, const float *color,
                          int width, int height, const int32_t *offsets, const int32_t *ids, int threads, float *rgb,
                          float *alpha) {
  const Scene scene(n, mean2d, conic, opacity, color, width, height, offsets, ids, threads);
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads)
  for (int tile = 0; tile < scene.tiles(); tile++) {
    Lanes T[TILE];
    Colors colors;
    walk(scene, tile, T, colors);
    const int left = tile % scene.across() * TILE, top = tile / scene.across() * TILE;
    for (int r = 0; r < TILE && top + r < height; r++)
      for (int c = 0; c < TILE && left + c < width; c++) {
        const size_t pixel = (size_t)(top + r) * width + left + c;
        rgb[3 * pixel] = colors.red[r][c], rgb[3 * pixel + 1] = colors.green[r][c];
        rgb[3 * pixel + 2] = colors.blue[r][c], alpha[pixel] = 1.0f - std::fabs(T[r][c]);
      }
  }
}

// image [H, W] holds ids below channels, -1 for none; features [n, channels] is added to.
extern "C" void lift_ids(int n, const float *mean2d, const float *conic, const float *opacity, int width, int height,
                         const int32_t *offsets, const int32_t *ids, int threads, const int32_t *image, int channels,
                         float *features) {
  const Scene scene(n, mean2d, conic, opacity, nullptr, width, height, offsets, ids, threads);
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads)
  for (int tile = 0; tile < scene.tiles(); tile++) {
    Lanes T[TILE];
    Ids sink(scene, tile, image, channels, features);
    walk(scene, tile, T, sink);
  }
}

// image [H, W, channels]; features [n, channels] and weight [n] are added to.
extern "C" void lift_dense(int n, const float *mean2d, const float *conic, const float *opacity, int width, int height,
                           const int32_t *offsets, const int32_t *ids, int threads, const float *image, int channels,
                           float *features, float *weight) {
  const Scene scene(n, mean2d, conic, opacity, nullptr, width, height, offsets, ids, threads);
  std::vector<std::atomic_flag> locks(n);
#pragma omp parallel num_threads(threads)
  {
    const int GROUP = 32;  // Gaussians whose sums stay in L2 while the slices pass
    Pairs pairs;
    const int padded = (channels + 63) / 64 * 64;
    std::vector<Lanes> sums(GROUP * padded / 16);
    std::vector<Lanes> slices(TILE * TILE * padded / 16);  // [slice][pixel][4 Lanes], fewer Lanes in the last slice
#pragma omp for schedule(dynamic, 4)
    for (int tile = 0; tile < scene.tiles(); tile++) {
      const int left = tile % scene.across() * TILE, top = tile / scene.across() * TILE;
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
