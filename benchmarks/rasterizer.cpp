// The compositing kernels of stages/splatting/raster.py once more, by hand, in AVX-512 intrinsics and
// OpenMP: what the numba kernels are measured against. Same tiles, same lists, same sums, no mask,
// three features. Compiled by benchmarks/rasterizer.py.

#include <immintrin.h>
#include <omp.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

namespace {

constexpr int TILE = 16, SCREEN = 12, SLOT = 16;
constexpr float ALPHA_MAX = 0.99f, TRANSMITTANCE_MIN = 1e-4f, SAFETY = 0.01f;
constexpr float HALF_LOG2E = 0.5f * 1.4426950408889634f;
constexpr int NEVER = 2147483647;

using V = __m512;

inline V set(float x) { return _mm512_set1_ps(x); }

inline V exp2_negative(V x) {
  x = _mm512_max_ps(x, set(-126.f));
  const __m512i whole = _mm512_cvttps_epi32(x);
  const V part = _mm512_sub_ps(x, _mm512_cvtepi32_ps(whole));
  V power = set(0.0067670840f);
  power = _mm512_fmadd_ps(power, part, set(0.053074066f));
  power = _mm512_fmadd_ps(power, part, set(0.23934107f));
  power = _mm512_fmadd_ps(power, part, set(0.69303020f));
  power = _mm512_fmadd_ps(power, part, set(0.99999741f));
  const __m512i bits = _mm512_add_epi32(_mm512_castps_si512(power), _mm512_slli_epi32(whole, 23));
  return _mm512_castsi512_ps(bits);
}

struct Ellipse {
  float mx, my, a, b, c, e, peak, slope, a2, e2;

  Ellipse(const float* q, int x0, int y0)
      : mx(q[0] - x0 - 0.5f), my(q[1] - y0 - 0.5f), a(q[2]), b(q[3]), c(q[4]), e(q[9]),
        peak(q[10]), slope(q[11]), a2(q[2] * HALF_LOG2E), e2(q[9] * HALF_LOG2E) {}

  V exponent(V lane, float dy, V& t) const {
    t = _mm512_sub_ps(lane, set(mx - slope * dy));
    return _mm512_fnmadd_ps(_mm512_mul_ps(set(a2), t), t, set(peak - e2 * dy * dy));
  }

  void rows(float reach, int columns, int rows, int& first, int& after) const {
    const float shift = slope * reach, left = -mx, right = columns - 1 - mx;
    const float at_top = std::min(std::max(-shift, left), right);
    const float at_bottom = std::min(std::max(shift, left), right);
    const float level = c * e * reach * reach, curve = a * e, inverse = 1 / c;
    const float top = (std::sqrt(level - curve * at_top * at_top) - b * at_top) * inverse;
    const float bottom = (-std::sqrt(level - curve * at_bottom * at_bottom) - b * at_bottom) * inverse;
    const float lowest = std::max(std::ceil(my + bottom - SAFETY), 0.f);
    const float highest = std::min(std::floor(my + top + SAFETY), float(rows - 1));
    first = after = 0;
    if (highest >= lowest) { first = int(lowest); after = int(highest) + 1; }
  }
};

// The sums of 16 vectors in the 16 lanes of one.
inline V sums(V (&rows)[16]) {
  const __m512i lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  for (int span = 8; span; span /= 2) {
    const __mmask16 second = _mm512_test_epi32_mask(lane, _mm512_set1_epi32(span));
    const __m512i low = _mm512_mask_add_epi32(lane, second, lane, _mm512_set1_epi32(16 - span));
    const __m512i high = _mm512_mask_add_epi32(
        _mm512_add_epi32(lane, _mm512_set1_epi32(span)), second, lane, _mm512_set1_epi32(16));
    for (int k = 0; k < span; k++)
      rows[k] = _mm512_add_ps(_mm512_permutex2var_ps(rows[k], low, rows[k + span]),
                              _mm512_permutex2var_ps(rows[k], high, rows[k + span]));
  }
  return rows[0];
}

const __m512i COUNT = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);

}  // namespace

extern "C" {

void set_threads(int threads) { omp_set_num_threads(threads); }

void composite_forward(int tiles_x, int tiles_y, int width, int height, const int* offsets,
                       const int* members, const float* screen, const float* features,
                       float alpha_cut, float* image, float* transmittance, int* stop, int* end,
                       int* spans) {
#pragma omp parallel for schedule(dynamic, 4)
  for (int tile = 0; tile < tiles_x * tiles_y; tile++) {
    const int x0 = tile % tiles_x * TILE, y0 = tile / tiles_x * TILE;
    const int rows = std::min(TILE, height - y0), columns = std::min(TILE, width - x0);
    alignas(64) float state[4][TILE][TILE], final_left[TILE][TILE];
    alignas(64) int until[TILE][TILE];
    std::memset(state, 0, sizeof state);
    std::memset(final_left, 0, sizeof final_left);
    for (int r = 0; r < TILE; r++)
      for (int x = 0; x < TILE; x++) {
        const bool inside = r < rows && x < columns;
        until[r][x] = inside ? NEVER : -1;
        state[0][r][x] = inside;
      }
    bool open[TILE];
    const V lane = _mm512_cvtepi32_ps(COUNT);
    const int first_pair = offsets[tile], last = offsets[tile + 1];
    int k = first_pair;
    for (; k < last; k++) {
      if ((k - first_pair) % 16 == 0) {
        bool some = false;
        for (int r = 0; r < TILE; r++) {
          open[r] = _mm512_reduce_max_epi32(_mm512_load_si512(until[r])) == NEVER;
          some |= open[r];
        }
        if (!some) break;
      }
      const float* q = screen + size_t(SCREEN) * members[k];
      const float* colour = features + size_t(3) * members[k];
      const Ellipse g(q, x0, y0);
      int first, after;
      g.rows(q[7], columns, rows, first, after);
      spans[k] = first + 256 * after;
      const V red = set(colour[0]), green = set(colour[1]), blue = set(colour[2]);
      for (int r = first; r < after; r++) {
        if (!open[r]) continue;
        V t;
        V alpha = exp2_negative(g.exponent(lane, r - g.my, t));
        alpha = _mm512_min_ps(alpha, set(ALPHA_MAX));
        alpha = _mm512_maskz_mov_ps(_mm512_cmp_ps_mask(alpha, set(alpha_cut), _CMP_GE_OQ), alpha);
        const V before = _mm512_load_ps(state[0][r]);
        V w = _mm512_mul_ps(alpha, before), left = _mm512_sub_ps(before, w);
        const __mmask16 finished =
            _mm512_cmp_ps_mask(left, set(TRANSMITTANCE_MIN), _CMP_LT_OQ) &
            _mm512_cmp_ps_mask(before, _mm512_setzero_ps(), _CMP_GT_OQ);
        if (finished) {
          _mm512_mask_store_epi32(until[r], finished, _mm512_set1_epi32(k));
          _mm512_mask_store_ps(final_left[r], finished, before);
          w = _mm512_mask_mov_ps(w, finished, _mm512_setzero_ps());
          left = _mm512_mask_mov_ps(left, finished, _mm512_setzero_ps());
        }
        _mm512_store_ps(state[0][r], left);
        _mm512_store_ps(state[1][r], _mm512_fmadd_ps(w, red, _mm512_load_ps(state[1][r])));
        _mm512_store_ps(state[2][r], _mm512_fmadd_ps(w, green, _mm512_load_ps(state[2][r])));
        _mm512_store_ps(state[3][r], _mm512_fmadd_ps(w, blue, _mm512_load_ps(state[3][r])));
      }
    }
    end[tile] = k;
    const size_t plane = size_t(width) * height;
    for (int r = 0; r < rows; r++)
      for (int x = 0; x < columns; x++) {
        const size_t pixel = size_t(y0 + r) * width + x0 + x;
        for (int j = 0; j < 3; j++) image[j * plane + pixel] = state[1 + j][r][x];
        transmittance[pixel] = until[r][x] == NEVER ? state[0][r][x] : final_left[r][x];
        stop[pixel] = until[r][x];
      }
  }
}

void composite_backward(int tiles_x, int tiles_y, int width, int height, const int* offsets,
                        const int* members, const float* screen, const float* features,
                        float alpha_cut, const float* transmittance, const int* stop,
                        const int* end, const int* spans, const float* d_image,
                        const float* d_transmittance, float* slot_sums) {
#pragma omp parallel for schedule(dynamic, 4)
  for (int tile = 0; tile < tiles_x * tiles_y; tile++) {
    const int x0 = tile % tiles_x * TILE, y0 = tile / tiles_x * TILE;
    const int rows = std::min(TILE, height - y0), columns = std::min(TILE, width - x0);
    alignas(64) float state[5][TILE][TILE];
    alignas(64) int until[TILE][TILE];
    std::memset(state, 0, sizeof state);
    std::memset(until, -1, sizeof until);
    const size_t plane = size_t(width) * height;
    for (int r = 0; r < rows; r++)
      for (int x = 0; x < columns; x++) {
        const size_t pixel = size_t(y0 + r) * width + x0 + x;
        until[r][x] = stop[pixel];
        state[0][r][x] = transmittance[pixel];
        state[1][r][x] = transmittance[pixel] * d_transmittance[pixel];
        for (int j = 0; j < 3; j++) state[2 + j][r][x] = d_image[j * plane + pixel];
      }
    int row_until[TILE];
    for (int r = 0; r < TILE; r++)
      row_until[r] = _mm512_reduce_max_epi32(_mm512_load_si512(until[r]));
    const V lane = _mm512_cvtepi32_ps(COUNT), zero = _mm512_setzero_ps(), one = set(1.f);
    for (int k = end[tile] - 1; k >= offsets[tile]; k--) {
      const float* colour = features + size_t(3) * members[k];
      const Ellipse g(screen + size_t(SCREEN) * members[k], x0, y0);
      const V red = set(colour[0]), green = set(colour[1]), blue = set(colour[2]);
      const __m512i here = _mm512_set1_epi32(k);
      V s = zero, sy = zero, syy = zero, abs_x = zero, abs_y = zero;
      V s_red = zero, s_green = zero, s_blue = zero;
      for (int r = spans[k] % 256; r < spans[k] / 256; r++) {
        if (row_until[r] <= k) continue;
        const float dy = r - g.my;
        V t;
        const V raw = exp2_negative(g.exponent(lane, dy, t));
        const __mmask16 taken = _mm512_cmp_ps_mask(raw, set(alpha_cut), _CMP_GE_OQ) &
                                _mm512_cmpgt_epi32_mask(_mm512_load_si512(until[r]), here);
        const V alpha = _mm512_maskz_min_ps(taken, raw, set(ALPHA_MAX));
        const V inverse = _mm512_div_ps(one, _mm512_sub_ps(one, alpha));
        const V before = _mm512_mul_ps(_mm512_load_ps(state[0][r]), inverse);
        const V d_red = _mm512_load_ps(state[2][r]), d_green = _mm512_load_ps(state[3][r]);
        const V d_blue = _mm512_load_ps(state[4][r]);
        V along = _mm512_mul_ps(d_red, red);
        along = _mm512_fmadd_ps(d_green, green, along);
        along = _mm512_fmadd_ps(d_blue, blue, along);
        const V w = _mm512_mul_ps(alpha, before), rest = _mm512_load_ps(state[1][r]);
        V ds = _mm512_fmsub_ps(rest, inverse, _mm512_mul_ps(before, along));
        ds = _mm512_maskz_mul_ps(_mm512_cmp_ps_mask(raw, set(ALPHA_MAX), _CMP_LE_OQ), alpha, ds);
        _mm512_store_ps(state[1][r], _mm512_fmadd_ps(w, along, rest));
        _mm512_store_ps(state[0][r], before);
        const V d = _mm512_mul_ps(ds, set(dy));
        s = _mm512_add_ps(s, ds);
        sy = _mm512_add_ps(sy, d);
        syy = _mm512_fmadd_ps(d, set(dy), syy);
        abs_x = _mm512_add_ps(abs_x, _mm512_abs_ps(_mm512_mul_ps(ds, t)));
        const V slope_y = _mm512_fmadd_ps(t, set(g.b), set(g.e * dy));
        abs_y = _mm512_add_ps(abs_y, _mm512_abs_ps(_mm512_mul_ps(ds, slope_y)));
        s_red = _mm512_fmadd_ps(w, d_red, s_red);
        s_green = _mm512_fmadd_ps(w, d_green, s_green);
        s_blue = _mm512_fmadd_ps(w, d_blue, s_blue);
      }
      const V dx = _mm512_sub_ps(lane, set(g.mx)), sx = _mm512_mul_ps(s, dx);
      V parts[16] = {s, sy, syy, sx, _mm512_mul_ps(sy, dx), _mm512_mul_ps(sx, dx), abs_x, abs_y,
                     s_red, s_green, s_blue, zero, zero, zero, zero, zero};
      _mm512_storeu_ps(slot_sums + size_t(SLOT) * k, sums(parts));
    }
    for (int k = end[tile]; k < offsets[tile + 1]; k++)
      _mm512_storeu_ps(slot_sums + size_t(SLOT) * k, zero);
  }
}
}
