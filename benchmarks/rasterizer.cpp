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

constexpr int TILE = 32, BLOCK = 4, SIDE = TILE / BLOCK, BLOCKS = SIDE * SIDE;
constexpr int SCREEN = 16, SLOT = 16;
constexpr float ALPHA_MAX = 0.999f, TRANSMITTANCE_MIN = 1e-4f, SAFETY = 0.01f;
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
  float mx, my, a, b, e, peak, slope, a2, e2;

  Ellipse(const float* q, int x0, int y0)
      : mx(q[0] - x0 - 0.5f), my(q[1] - y0 - 0.5f), a(q[2]), b(q[3]), e(q[9]), peak(q[10]),
        slope(q[11]), a2(q[2] * HALF_LOG2E), e2(q[9] * HALF_LOG2E) {}

  V exponent(V dy, V t) const {
    const V power = _mm512_fnmadd_ps(_mm512_mul_ps(set(e2), dy), dy, set(peak));
    return _mm512_fnmadd_ps(_mm512_mul_ps(set(a2), t), t, power);
  }

  // The blocks of a tile that it touches: lanes 0-7 the right end of each row of blocks, 8-15 the
  // left end.
  uint64_t blocks(const float* q) const {
    const float height = q[7];
    const V band = _mm512_setr_ps(0, 4, 8, 12, 16, 20, 24, 28, 0, 4, 8, 12, 16, 20, 24, 28);
    const V sign = _mm512_setr_ps(1, 1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1, -1, -1, -1);
    const V offset = _mm512_mask_blend_ps(0xff00, set(1.f), set(SIDE + 1 - 1.f / BLOCK));
    const V top = _mm512_sub_ps(band, set(my)), bottom = _mm512_add_ps(top, set(BLOCK - 1));
    const __mmask16 touched = _mm512_cmp_ps_mask(top, set(height + SAFETY), _CMP_LE_OQ) &
                              _mm512_cmp_ps_mask(bottom, set(-height - SAFETY), _CMP_GE_OQ);
    const V y = _mm512_min_ps(_mm512_max_ps(_mm512_mul_ps(sign, set(q[12])), top), bottom);
    const V extent = _mm512_sqrt_ps(_mm512_max_ps(
        _mm512_mul_ps(_mm512_fnmadd_ps(y, y, set(height * height)), set(e * q[13])), set(0)));
    V reach = _mm512_mul_ps(_mm512_fnmadd_ps(set(slope), y, set(mx)), sign);
    reach = _mm512_add_ps(_mm512_add_ps(reach, extent), set(SAFETY));
    reach = _mm512_fmadd_ps(reach, set(1.f / BLOCK), offset);
    reach = _mm512_min_ps(_mm512_max_ps(reach, set(0)), set(SIDE));
    const __m512i counts = _mm512_maskz_cvttps_epi32(touched, reach);
    const __m256i ends = _mm512_castsi512_si256(counts);
    const __m256i starts = _mm512_extracti64x4_epi64(counts, 1);
    const __m256i below = _mm256_sub_epi32(_mm256_sllv_epi32(_mm256_set1_epi32(1), ends),
                                           _mm256_set1_epi32(1));
    const __m256i chosen = _mm256_andnot_si256(_mm256_srlv_epi32(_mm256_set1_epi32(255), starts), below);
    return uint64_t(_mm_cvtsi128_si64(_mm256_cvtepi32_epi8(chosen)));
  }
};

// A tile of a plane as vectors, and back; the image is cut off at its right and lower edge.
template <class T>
void read_tile(const T* plane, int x0, int y0, int width, int height, T outside, T (*tile)[16]) {
  for (int block = 0; block < BLOCKS; block++)
    for (int lane = 0; lane < 16; lane++) {
      const int x = x0 + block % SIDE * BLOCK + lane % BLOCK;
      const int y = y0 + block / SIDE * BLOCK + lane / BLOCK;
      tile[block][lane] = x < width && y < height ? plane[size_t(y) * width + x] : outside;
    }
}

template <class T>
void write_tile(const T (*tile)[16], int x0, int y0, int width, int height, T* plane) {
  for (int y = y0; y < std::min(height, y0 + TILE); y++)
    for (int x = x0; x < std::min(width, x0 + TILE); x++) {
      const int block = (y - y0) / BLOCK * SIDE + (x - x0) / BLOCK;
      plane[size_t(y) * width + x] = tile[block][(y - y0) % BLOCK * BLOCK + (x - x0) % BLOCK];
    }
}

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

const V COLUMN = _mm512_setr_ps(0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3);
const V ROW = _mm512_setr_ps(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);

}  // namespace

extern "C" {

void set_threads(int threads) { omp_set_num_threads(threads); }

void composite_forward(int tiles_x, int tiles_y, int width, int height, const int* offsets,
                       const int* members, const float* screen, const float* features,
                       float alpha_cut, float* image, float* transmittance, int* stop,
                       uint64_t* blocks) {
#pragma omp parallel for schedule(dynamic, 1)
  for (int tile = 0; tile < tiles_x * tiles_y; tile++) {
    const int x0 = tile % tiles_x * TILE, y0 = tile / tiles_x * TILE;
    alignas(64) float state[4][BLOCKS][16], final_left[BLOCKS][16];
    alignas(64) int until[BLOCKS][16];
    std::memset(state, 0, sizeof state);
    uint64_t open = 0;
    for (int block = 0; block < BLOCKS; block++)
      for (int lane = 0; lane < 16; lane++) {
        const bool inside = x0 + block % SIDE * BLOCK + lane % BLOCK < width &&
                            y0 + block / SIDE * BLOCK + lane / BLOCK < height;
        until[block][lane] = inside ? NEVER : -1;
        state[0][block][lane] = inside;
        final_left[block][lane] = 1;
        open |= uint64_t(inside) << block;
      }
    const int last = offsets[tile + 1];
    int k = offsets[tile];
    for (; k < last && open; k++) {
      const float* q = screen + size_t(SCREEN) * members[k];
      const float* colour = features + size_t(3) * members[k];
      const Ellipse g(q, x0, y0);
      uint64_t todo = open & g.blocks(q);
      blocks[k] = todo;
      const V red = set(colour[0]), green = set(colour[1]), blue = set(colour[2]);
      const V from_x = _mm512_sub_ps(COLUMN, set(g.mx)), from_y = _mm512_sub_ps(ROW, set(g.my));
      for (; todo; todo &= todo - 1) {
        const int r = __builtin_ctzll(todo);
        const V dx = _mm512_add_ps(from_x, set(r % SIDE * BLOCK));
        const V dy = _mm512_add_ps(from_y, set(r / SIDE * BLOCK));
        const V t = _mm512_fmadd_ps(set(g.slope), dy, dx);
        V alpha = exp2_negative(g.exponent(dy, t));
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
          if (_mm512_reduce_max_epi32(_mm512_load_si512(until[r])) != NEVER)
            open &= ~(uint64_t(1) << r);
        }
        _mm512_store_ps(state[0][r], left);
        _mm512_store_ps(state[1][r], _mm512_fmadd_ps(w, red, _mm512_load_ps(state[1][r])));
        _mm512_store_ps(state[2][r], _mm512_fmadd_ps(w, green, _mm512_load_ps(state[2][r])));
        _mm512_store_ps(state[3][r], _mm512_fmadd_ps(w, blue, _mm512_load_ps(state[3][r])));
      }
    }
    for (; k < last; k++) blocks[k] = 0;
    for (int block = 0; block < BLOCKS; block++)
      for (int lane = 0; lane < 16; lane++)
        if (until[block][lane] != NEVER) state[0][block][lane] = final_left[block][lane];
    const size_t plane = size_t(width) * height;
    write_tile(state[0], x0, y0, width, height, transmittance);
    write_tile(until, x0, y0, width, height, stop);
    for (int j = 0; j < 3; j++) write_tile(state[1 + j], x0, y0, width, height, image + j * plane);
  }
}

void composite_backward(int tiles_x, int tiles_y, int width, int height, const int* offsets,
                        const int* members, const float* screen, const float* features,
                        float alpha_cut, const int* slots, const float* transmittance,
                        const int* stop, const uint64_t* blocks, const float* d_image,
                        const float* d_transmittance, float* slot_sums) {
#pragma omp parallel for schedule(dynamic, 1)
  for (int tile = 0; tile < tiles_x * tiles_y; tile++) {
    const int x0 = tile % tiles_x * TILE, y0 = tile / tiles_x * TILE;
    alignas(64) float state[5][BLOCKS][16];
    alignas(64) int until[BLOCKS][16];
    const size_t plane = size_t(width) * height;
    read_tile(stop, x0, y0, width, height, -1, until);
    read_tile(transmittance, x0, y0, width, height, 0.f, state[0]);
    read_tile(d_transmittance, x0, y0, width, height, 0.f, state[1]);
    for (int j = 0; j < 3; j++)
      read_tile(d_image + j * plane, x0, y0, width, height, 0.f, state[2 + j]);
    for (int block = 0; block < BLOCKS; block++)
      for (int lane = 0; lane < 16; lane++) state[1][block][lane] *= state[0][block][lane];
    const V zero = _mm512_setzero_ps(), one = set(1.f);
    for (int k = offsets[tile + 1] - 1; k >= offsets[tile]; k--) {
      const float* colour = features + size_t(3) * members[k];
      const Ellipse g(screen + size_t(SCREEN) * members[k], x0, y0);
      const V red = set(colour[0]), green = set(colour[1]), blue = set(colour[2]);
      const V from_x = _mm512_sub_ps(COLUMN, set(g.mx)), from_y = _mm512_sub_ps(ROW, set(g.my));
      const __m512i here = _mm512_set1_epi32(k);
      V s = zero, sx = zero, sy = zero, sxx = zero, sxy = zero, syy = zero;
      V abs_x = zero, abs_y = zero, s_red = zero, s_green = zero, s_blue = zero;
      for (uint64_t todo = blocks[k]; todo; todo &= todo - 1) {
        const int r = __builtin_ctzll(todo);
        const V dx = _mm512_add_ps(from_x, set(r % SIDE * BLOCK));
        const V dy = _mm512_add_ps(from_y, set(r / SIDE * BLOCK));
        const V t = _mm512_fmadd_ps(set(g.slope), dy, dx);
        const V raw = exp2_negative(g.exponent(dy, t));
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
        const V by_x = _mm512_mul_ps(ds, dx), by_y = _mm512_mul_ps(ds, dy);
        s = _mm512_add_ps(s, ds);
        sx = _mm512_add_ps(sx, by_x);
        sy = _mm512_add_ps(sy, by_y);
        sxx = _mm512_fmadd_ps(by_x, dx, sxx);
        sxy = _mm512_fmadd_ps(by_x, dy, sxy);
        syy = _mm512_fmadd_ps(by_y, dy, syy);
        abs_x = _mm512_add_ps(abs_x, _mm512_abs_ps(_mm512_mul_ps(ds, t)));
        const V slope_y = _mm512_fmadd_ps(t, set(g.b), _mm512_mul_ps(set(g.e), dy));
        abs_y = _mm512_add_ps(abs_y, _mm512_abs_ps(_mm512_mul_ps(ds, slope_y)));
        s_red = _mm512_fmadd_ps(w, d_red, s_red);
        s_green = _mm512_fmadd_ps(w, d_green, s_green);
        s_blue = _mm512_fmadd_ps(w, d_blue, s_blue);
      }
      V parts[16] = {s, sy, syy, sx, sxy, sxx, abs_x, abs_y,
                     s_red, s_green, s_blue, zero, zero, zero, zero, zero};
      _mm512_storeu_ps(slot_sums + size_t(SLOT) * slots[k], sums(parts));
    }
  }
}
}
