// 16 floats at a time for the limits: AVX-512 where there is some, and the same by loops where there is none.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#ifdef __AVX512BW__
#include <immintrin.h>
#endif

namespace {

constexpr int TILE = 16;
constexpr float ALPHA_MIN = 1.0f / 255.0f, ALPHA_MAX = 0.999f, TRANSMITTANCE_MIN = 1e-4f, LOG2E = 1.44269504f;

typedef float Lanes __attribute__((vector_size(64)));  // 16 pixels of a row, 16 rows of a tile, or 16 Gaussians
typedef int32_t Ints __attribute__((vector_size(64)));
typedef uint16_t Mask;  // one bit per lane

const Lanes IOTA = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

inline Lanes all(float value) { return Lanes{} + value; }
inline Lanes load(const float *from) {
  Lanes value;
  std::memcpy(&value, from, 64);
  return value;
}
inline void store(float *to, Lanes value) { std::memcpy(to, &value, 64); }

#ifdef __AVX512BW__
inline Lanes load_if(bool wanted, const float *from) { return _mm512_maskz_loadu_ps(-(int)wanted, from); }
inline Mask greater_equal(Lanes a, Lanes b, Mask where = 0xffff) {
  return _mm512_mask_cmp_ps_mask(where, a, b, _CMP_GE_OQ);
}
inline Mask greater(Lanes a, Lanes b, Mask where) { return _mm512_mask_cmp_ps_mask(where, a, b, _CMP_GT_OQ); }
inline Mask equal(Ints a, int32_t b) { return _mm512_cmpeq_epi32_mask((__m512i)a, _mm512_set1_epi32(b)); }
inline uint32_t having(const uint16_t *values, int bit) {  // which of 32 values, aligned to 64 bytes, have a bit set
  return _mm512_test_epi16_mask(_mm512_load_si512(values), _mm512_set1_epi16(1 << bit));
}
// Of 16 values: which are not zero; and those, appended: returns how many, writes up to 16.
inline Mask nonzero(const uint16_t *values) {
  const __m256i all = _mm256_load_si256((const __m256i *)values);
  return _mm256_test_epi16_mask(all, all);
}
inline int compress(const uint16_t *values, uint16_t *to) {
  const Mask mask = nonzero(values);
  const __m512i wide = _mm512_cvtepu16_epi32(_mm256_load_si256((const __m256i *)values));
  _mm256_storeu_si256((__m256i *)to, _mm512_cvtepi32_epi16(_mm512_maskz_compress_epi32(mask, wide)));
  return __builtin_popcount(mask);
}
inline Lanes select(Mask mask, Lanes yes, Lanes no) { return _mm512_mask_blend_ps(mask, no, yes); }
inline Lanes masked(Mask mask, Lanes value) { return _mm512_maskz_mov_ps(mask, value); }
inline Lanes smaller(Lanes a, Lanes b) { return _mm512_min_ps(a, b); }
inline Lanes larger(Lanes a, Lanes b) { return _mm512_max_ps(a, b); }
inline Lanes root(Lanes a) { return _mm512_sqrt_ps(a); }
inline float sum(Lanes a) { return _mm512_reduce_add_ps(a); }
// Append the lanes in mask, and their indices counted from base; returns how many. Writes up to 16 of each.
inline int compress(Mask mask, Lanes value, int base, float *values, uint8_t *indices) {
  _mm512_storeu_ps(values, _mm512_maskz_compress_ps(mask, value));
  const __m512i lanes = _mm512_add_epi32(_mm512_cvtps_epi32(IOTA), _mm512_set1_epi32(base));
  _mm_storeu_si128((__m128i *)indices, _mm512_cvtepi32_epi8(_mm512_maskz_compress_epi32(mask, lanes)));
  return __builtin_popcount(mask);
}
inline Lanes fraction(Lanes x) { return _mm512_reduce_ps(x, _MM_FROUND_TO_NEG_INF); }
inline Lanes scale(Lanes mantissa, Lanes x) { return _mm512_scalef_ps(mantissa, x); }  // times 2^floor(x)
// 1 / x to 1e-7 relative, for x that is neither tiny nor huge: a table look-up and a step of Newton's method.
inline Lanes reciprocal(Lanes x) {
  const Lanes guess = _mm512_rcp14_ps(x);
  return guess * (2.0f - x * guess);
}
// Past the caches, for results that nobody reads soon; `to` is aligned to 64 bytes.
inline void stream(float *to, Lanes value) { _mm512_stream_ps(to, value); }
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
inline Lanes load_if(bool wanted, const float *from) { return wanted ? load(from) : Lanes{}; }
inline Mask greater_equal(Lanes a, Lanes b, Mask where = 0xffff) {
  return where & bits([&](int i) { return a[i] >= b[i]; });
}
inline Mask greater(Lanes a, Lanes b, Mask where) { return where & bits([&](int i) { return a[i] > b[i]; }); }
inline Mask equal(Ints a, int32_t b) { return bits([&](int i) { return a[i] == b; }); }
inline uint32_t having(const uint16_t *values, int bit) {
  uint32_t result = 0;
  for (int i = 0; i < 32; i++) result |= (uint32_t)(values[i] >> bit & 1) << i;
  return result;
}
inline Mask nonzero(const uint16_t *values) {
  return bits([&](int i) { return values[i] != 0; });
}
inline int compress(const uint16_t *values, uint16_t *to) {
  int count = 0;
  for (int i = 0; i < 16; i++)
    if (values[i]) to[count++] = values[i];
  return count;
}
inline Lanes select(Mask m, Lanes yes, Lanes no) { return lanes([&](int i) { return m >> i & 1 ? yes[i] : no[i]; }); }
inline Lanes masked(Mask mask, Lanes value) { return select(mask, value, Lanes{}); }
inline Lanes smaller(Lanes a, Lanes b) { return lanes([&](int i) { return a[i] < b[i] ? a[i] : b[i]; }); }
inline Lanes larger(Lanes a, Lanes b) { return lanes([&](int i) { return a[i] > b[i] ? a[i] : b[i]; }); }
inline Lanes root(Lanes a) { return lanes([&](int i) { return std::sqrt(a[i]); }); }
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
inline Lanes fraction(Lanes x) { return lanes([&](int i) { return x[i] - std::floor(x[i]); }); }
inline Lanes scale(Lanes mantissa, Lanes x) {
  return lanes([&](int i) { return std::ldexp(mantissa[i], (int)std::floor(x[i])); });
}
inline Lanes reciprocal(Lanes x) { return 1.0f / x; }
inline void stream(float *to, Lanes value) { store(to, value); }
#endif

inline Lanes negative(Lanes x) { return (Lanes)((Ints)x | INT32_MIN); }  // -|x|
inline Lanes clamp(Lanes x, float low, float high) { return smaller(larger(x, all(low)), all(high)); }

// 2^x to 1.5e-7 relative: x is split at the integer below, the rest goes into the minimax polynomial of degree 5.
inline Lanes exp2(Lanes x) {
  const Lanes f = fraction(x);
  Lanes p = all(1.877576680e-3f) * f + 8.989340284e-3f;
  p = p * f + 5.582631767e-2f;
  p = p * f + 2.401536173e-1f;
  p = p * f + 6.931530731e-1f;
  p = p * f + 9.999999251e-1f;
  return scale(p, x);
}

inline Lanes log2(Lanes x) {
  Lanes result;
#pragma omp simd
  for (int i = 0; i < 16; i++) result[i] = LOG2E * std::log(x[i]);
  return result;
}

// [x | y], each with every block of 2 HALF lanes added up to HALF: 8 lanes of one, 8 of the other.
template <int HALF> inline Lanes fold(Lanes x, Lanes y) {
  Ints low, high;
  for (int i = 0; i < 16; i++) {
    low[i] = (i & 8) * 2 + (i & 7) / HALF * 2 * HALF + (i & 7) % HALF;
    high[i] = low[i] + HALF;
  }
  return __builtin_shuffle(x, y, low) + __builtin_shuffle(x, y, high);
}

// Lane q of the result is the sum of the lanes of v[q], q < COUNT <= 16; other lanes are anything.
template <int COUNT> inline Lanes sums(const Lanes *v) {
  Lanes eights[8], fours[4];
  for (int i = 0; i < (COUNT + 1) / 2; i++) eights[i] = fold<8>(v[2 * i], v[std::min(2 * i + 1, COUNT - 1)]);
  for (int i = 0; i < (COUNT + 3) / 4; i++)
    fours[i] = fold<4>(eights[2 * i], eights[std::min(2 * i + 1, (COUNT - 1) / 2)]);
  const Lanes first = fold<2>(fours[0], fours[COUNT > 4]);
  return fold<1>(first, COUNT > 8 ? fold<2>(fours[2], fours[COUNT > 12 ? 3 : 2]) : first);
}

// One step of the transposition: squares of STRIDE lanes change places across the diagonal of those twice as large.
template <int STRIDE> inline void exchange(Lanes *rows) {
  Ints low, high;
  for (int i = 0; i < 16; i++) {
    low[i] = i & STRIDE ? 16 + i - STRIDE : i;
    high[i] = i & STRIDE ? 16 + i : i + STRIDE;
  }
  for (int i = 0; i < 16; i++)
    if (!(i & STRIDE)) {
      const Lanes a = rows[i], b = rows[i + STRIDE];
      rows[i] = __builtin_shuffle(a, b, low);
      rows[i + STRIDE] = __builtin_shuffle(a, b, high);
    }
}

// Rows and columns of 16 x 16 floats change places.
inline void transpose(Lanes *rows) {
  exchange<8>(rows);
  exchange<4>(rows);
  exchange<2>(rows);
  exchange<1>(rows);
}

// Where the lanes of an interleaved vector come from, one shuffle of two vectors after the other.
template <int K> struct Places {
  int32_t apart[K][K][16] = {}, together[K][K][16] = {};  // [out][step][lane], 16 and up: of the vector that step adds
  constexpr Places() {
    for (int out = 0; out < K; out++)
      for (int step = 1; step < K; step++)
        for (int i = 0; i < 16; i++) {
          const int from = K * i + out, to = 16 * out + i;
          apart[out][step][i] = from / 16 == step ? 16 + from % 16 : step == 1 ? from % 16 : i;
          together[out][step][i] = to % K == step ? 16 + to / K : step == 1 ? to / K : i;
        }
  }
};
template <int K> constexpr Places<K> PLACES;

inline Lanes shuffled(Lanes a, Lanes b, const int32_t *places) {
  Ints lanes;
  std::memcpy(&lanes, places, 64);
  return __builtin_shuffle(a, b, lanes);
}

// out[k] holds element k of 16 consecutive groups of K floats.
template <int K> inline void deinterleave(const float *from, Lanes *out) {
  for (int k = 0; k < K; k++) {
    out[k] = load(from);
    for (int step = 1; step < K; step++) out[k] = shuffled(out[k], load(from + 16 * step), PLACES<K>.apart[k][step]);
  }
}

// The other way round.
template <int K> inline void interleave(const Lanes *from, float *to) {
  for (int out = 0; out < K; out++) {
    Lanes value = from[0];
    for (int step = 1; step < K; step++) value = shuffled(value, from[step], PLACES<K>.together[out][step]);
    store(to + 16 * out, value);
  }
}

}  // namespace
