// Depth order and tile lists by hand: a radix sort of the splats, then counting in slices of the depth order.
#pragma once

#include <atomic>
#include <cstdlib>
#include <sys/mman.h>
#include <vector>

#include <omp.h>

#include "limit_project.h"

namespace {

// Memory that stays between calls: only the first one pays for its pages.
template <class T> struct Buffer {
  T *data = nullptr;
  size_t size = 0;
  ~Buffer() { std::free(data); }
  void reserve(size_t count) {
    if (count <= size) return;
    std::free(data);
    constexpr size_t PAGE = 1 << 21;
    const size_t bytes = ((count + count / 4) * sizeof(T) + PAGE - 1) / PAGE * PAGE;
    data = (T *)std::aligned_alloc(PAGE, bytes);
    madvise(data, bytes, MADV_HUGEPAGE);
    std::memset((void *)data, 0, bytes);
    size = bytes / sizeof(T);
  }
  T &operator[](size_t i) { return data[i]; }
};

// Splats by (depth, index). Depths are positive, so that their bits are in order.
struct DepthOrder {
  static constexpr int DIGIT = 11;  // bits of a pass
  Buffer<uint64_t> pairs[2];        // depth above the splat's number
  std::vector<int32_t> counts;      // [threads, 2^DIGIT]
  Buffer<int32_t> order;

  // splats of chunk c are number CHUNK c and the held[c] - 1 that follow; starts[c] splats come before them.
  void sort(const Splat *splats, const int32_t *held, const int32_t *starts, int chunks, int threads) {
    const int total = starts[chunks];
    for (auto &half : pairs) half.reserve(total);
    order.reserve(total);
    counts.resize((size_t)threads << DIGIT);
    uint32_t least = UINT32_MAX, most = 0;
#pragma omp parallel num_threads(threads)
    {
#pragma omp for schedule(static) reduction(min : least) reduction(max : most)
      for (int c = 0; c < chunks; c++)
        for (int i = 0; i < held[c]; i++) {
          const uint32_t id = CHUNK * c + i;
          uint32_t depth;
          std::memcpy(&depth, &splats[id].depth, 4);
          least = std::min(least, depth), most = std::max(most, depth);
          pairs[0][starts[c] + i] = (uint64_t)depth << 32 | id;
        }
    }
    const int bits = total ? 32 - __builtin_clz((most - least) | 1) : 0, passes = (bits + DIGIT - 1) / DIGIT;
    const int digit = passes ? (bits + passes - 1) / passes : 0;
#pragma omp parallel num_threads(threads)
    {
      const int thread = omp_get_thread_num(), team = omp_get_num_threads();
      const int begin = (int64_t)total * thread / team, end = (int64_t)total * (thread + 1) / team;
      int32_t *mine = &counts[(size_t)thread << DIGIT];
      for (int pass = 0; pass < passes; pass++) {
        const uint64_t *from = pairs[pass & 1].data;
        uint64_t *to = pairs[~pass & 1].data;
        const auto digit_of = [&](uint64_t pair) {
          return ((uint32_t)(pair >> 32) - least) >> (pass * digit) & ((1u << digit) - 1);
        };
        std::memset(mine, 0, sizeof(int32_t) << digit);
        for (int i = begin; i < end; i++) mine[digit_of(from[i])]++;
#pragma omp barrier
#pragma omp single
        {
          int32_t place = 0;
          for (int d = 0; d < 1 << digit; d++)
            for (int t = 0; t < team; t++) {
              int32_t &count = counts[((size_t)t << DIGIT) + d];
              const int32_t here = count;
              count = place, place += here;
            }
        }
        if (pass + 1 < passes)
          for (int i = begin; i < end; i++) to[mine[digit_of(from[i])]++] = from[i];
        else
          for (int i = begin; i < end; i++) order[mine[digit_of(from[i])]++] = (uint32_t)from[i];
#pragma omp barrier
      }
    }
  }
};

// Which splats each tile composites, front to back: exactly those that reach one of its pixel centres' rectangle.
struct TileLists {
  // Tile columns of a splat within a row of tiles; before them, the rows of the splat.
  struct Span { uint16_t first, last; };
  std::vector<int32_t> cursors;          // [slices, tiles]
  std::vector<std::vector<Span>> spans;  // of every slice, splat by splat
  Buffer<int32_t> offsets, ids;

  // The rows of a splat and its spans; returns how many rows there are.
  static int spans_of(const Splat &s, int width, int height, Span *out) {
    const int top = std::max((int)std::ceil(s.y - s.half_height - 0.5f), 0);
    const int bottom = std::min((int)std::floor(s.y + s.half_height - 0.5f), height - 1);
    const int box_first = std::max((int)std::ceil(s.x - s.half_width - 0.5f), 0);
    const int box_last = std::min((int)std::floor(s.x + s.half_width - 0.5f), width - 1);
    const bool cut = s.x < s.half_width || s.x + s.half_width > width;
    const bool narrow = box_first / TILE == box_last / TILE && !cut;
    const float q = s.L - std::log2(ALPHA_MIN) + SLACK, inverse = -0.5f / s.A;
    const float D = -4.0f * s.A * q, E = 4.0f * s.A * s.C - s.B * s.B;
    const float summit = -0.5f * s.B * s.half_width / s.C;  // dy at which the footprint reaches furthest to the right
    const int rows = top <= bottom ? bottom / TILE - top / TILE + 1 : 0;
    *out++ = {(uint16_t)(top / TILE), (uint16_t)rows};
    for (int row = top / TILE; row < top / TILE + rows; row++) {
      int first = box_first, last = box_last;
      if (!narrow) {
        const float low = std::max(row * TILE + 0.5f - s.y, -s.half_height);
        const float high = std::min(row * TILE + TILE - 0.5f - s.y, s.half_height);
        const float at_right = std::min(std::max(summit, low), high), at_left = std::min(std::max(-summit, low), high);
        const float right = s.ridge * at_right + inverse * std::sqrt(std::max(D - E * at_right * at_right, 0.0f));
        const float left = s.ridge * at_left - inverse * std::sqrt(std::max(D - E * at_left * at_left, 0.0f));
        first = std::max((int)std::ceil(s.x + left - 0.5f), 0);
        last = std::min((int)std::floor(s.x + right - 0.5f), width - 1);
      }
      *out++ = first <= last ? Span{(uint16_t)(first / TILE), (uint16_t)(last / TILE)} : Span{1, 0};
    }
    return rows;
  }

  int build(const Splat *splats, const int32_t *order, int count, int width, int height, int threads) {
    const int columns = (width + TILE - 1) / TILE, down = (height + TILE - 1) / TILE, tiles = columns * down;
    const int slices = threads == 1 ? 1 : 8 * threads;
    cursors.resize((size_t)slices * tiles);
    spans.resize(slices);
    offsets.reserve(tiles + 1);
    const auto begin = [&](int slice) { return (int)((int64_t)count * slice / slices); };
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (int slice = 0; slice < slices; slice++) {
      int32_t *counts = &cursors[(size_t)slice * tiles];
      std::memset(counts, 0, sizeof(int32_t) * tiles);
      auto &mine = spans[slice];
      size_t used = 0;
      for (int k = begin(slice); k < begin(slice + 1); k++) {
        if (k + 12 < count) __builtin_prefetch(&splats[order[k + 12]]);
        if (mine.size() < used + down + 1) mine.resize(2 * used + 16 * down);
        const int rows = spans_of(splats[order[k]], width, height, &mine[used]);
        const Span *span = &mine[used];
        int32_t *row = counts + span->first * columns;
        for (int r = 0; r < rows; r++, row += columns) {
          span++;
          for (int column = span->first; column <= span->last; column++) row[column]++;
        }
        used += rows + 1;
      }
    }
    int total = 0;
    for (int tile = 0; tile < tiles; tile++) {
      offsets[tile] = total;
      for (int slice = 0; slice < slices; slice++) {
        int32_t &cursor = cursors[(size_t)slice * tiles + tile];
        const int here = cursor;
        cursor = total, total += here;
      }
    }
    offsets[tiles] = total;
    ids.reserve(total);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (int slice = 0; slice < slices; slice++) {
      int32_t *places = &cursors[(size_t)slice * tiles];
      const Span *span = spans[slice].data();
      for (int k = begin(slice); k < begin(slice + 1); k++) {
        const int rows = span->last;
        int32_t *row = places + span++->first * columns;
        for (int r = 0; r < rows; r++, row += columns, span++)
          for (int column = span->first; column <= span->last; column++) ids[row[column]++] = order[k];
      }
    }
    return total;
  }
};

}  // namespace
