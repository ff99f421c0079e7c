// (1 - lambda) L1 + lambda (1 - SSIM) and its gradient, fused (docs/math.md, section "SSIM").
//
// SSIM needs five filtered images; only the sum of the two variances enters, so four do: x, y, x² + y², x y. The
// 11-tap window is separable and runs over rows of interleaved RGB (neighbours are three floats apart), in strips
// narrow enough that the eleven rows under the window stay in cache. Sums go row by row in double: the same bits for
// any number of threads.
#pragma once
#include "frame.h"
#include "parallel.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

constexpr int kRadius = 5, kTaps = 2 * kRadius + 1, kStrip = 384, kHalo = 3 * kRadius;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
// exp(-k² / (2 1.5²)), normalised over k = -5..5; index = |k|.
constexpr float kWindow[kRadius + 1] = {0.26601172f, 0.21300553f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};

// Along a row: in points at the strip's first float of a row that is readable kHalo floats beyond either end.
inline void filter_row(const float* in, float* out, int n) {
  for (int i = 0; i < n; i += 8) {
    f8 sum = load8(in + i) * kWindow[0];
    for (int k = 1; k <= kRadius; ++k) sum += (load8(in + i - 3 * k) + load8(in + i + 3 * k)) * kWindow[k];
    store8(out + i, sum);
  }
}

// The last eleven filtered rows. Each row is written twice, eleven slots apart, so that any window is contiguous.
template <int Maps> struct Ring {
  static constexpr int kStride = kStrip + 8;
  alignas(64) float slot[2 * kTaps][Maps][kStride];

  // Row y, for any y >= -kRadius, from what `write` puts into one float[kStride].
  template <class Write> void put(int y, int map, Write&& write) {
    float* first = slot[(y + kTaps) % kTaps][map];
    write(first);
    std::memcpy(slot[(y + kTaps) % kTaps + kTaps][map], first, sizeof(float) * kStride);
  }
  // The topmost of the eleven rows around y.
  const float* window(int y, int map) const { return slot[(y + kTaps - kRadius) % kTaps][map]; }

  // Across rows, at float i of the window that begins at `top`.
  static f8 filter(const float* top, int i) {
    constexpr int row = Maps * kStride;
    const float* center = top + kRadius * row + i;
    f8 sum = load8(center) * kWindow[0];
    for (int k = 1; k <= kRadius; ++k) sum += (load8(center - k * row) + load8(center + k * row)) * kWindow[k];
    return sum;
  }
};

// A piece of a row with kHalo floats on both sides, zeros outside the image.
struct Piece {
  alignas(64) float data[kHalo + 1 + kStrip + kHalo + 16];
  float* at() { return data + kHalo + 1; }
  void load(const float* row, int width, int x0, int n) {
    const int first = x0 - kHalo < 0 ? 0 : x0 - kHalo, end = x0 + n + kHalo > width ? width : x0 + n + kHalo;
    std::memset(data, 0, sizeof(data));
    std::memcpy(at() + (first - x0), row + first, sizeof(float) * (end - first));
  }
};

struct Band {
  int y0, y1, x0, n, width, height;  // rows; floats of a row
};

// The partial derivatives of SSIM at one pixel-channel with respect to E[x], E[x² + y²], E[x y], and SSIM itself.
inline f8 ssim_partials(f8 mx, f8 my, f8 square, f8 product, f8& d_mean, f8& d_square, f8& d_product) {
  const f8 mxx = mx * mx + my * my, mxy = mx * my;
  const f8 a1 = mxy * 2.f + kC1, a2 = (product - mxy) * 2.f + kC2, b1 = mxx + kC1, b2 = (square - mxx) + kC2;
  const f8 inverse = splat<f8>(1.f) / (b1 * b2), ssim = a1 * a2 * inverse;
  d_product = a1 * inverse * 2.f;
  d_square = splat<f8>(0.f) - ssim * b1 * inverse;
  d_mean = (my * (a2 - a1) - mx * ssim * (b2 - b1)) * inverse * 2.f;
  return ssim;
}

using d8 = double __attribute__((vector_size(64)));

// Adds the first n lanes to a running sum in double.
inline void accumulate(d8& sum, f8 v, int n) {
  if (n < 8)
    for (int l = n; l < 8; ++l) v[l] = 0.f;
  sum += __builtin_convertvector(v, d8);
}
inline double total(d8 v) { return ((v[0] + v[1]) + (v[2] + v[3])) + ((v[4] + v[5]) + (v[6] + v[7])); }

// Pass 1: SSIM and its partials (three maps of the image's size), for the rows of a band and the floats of a strip.
inline void ssim_band(const PhotometricArguments& a, const Band& band, float* const maps[3], double* row_ssim) {
  Ring<4> ring;
  Piece x, y, square, product;
  for (int row = band.y0 - kRadius; row < band.y1 + kRadius; ++row) {
    if (row < 0 || row >= band.height) {
      for (int m = 0; m < 4; ++m) ring.put(row, m, [](float* out) { std::memset(out, 0, sizeof(float) * kStrip); });
    } else {
      x.load(a.rendered + static_cast<int64_t>(row) * band.width, band.width, band.x0, band.n);
      y.load(a.target + static_cast<int64_t>(row) * band.width, band.width, band.x0, band.n);
      for (int i = -16; i < band.n + kHalo; i += 8) {
        const f8 vx = load8(x.at() + i), vy = load8(y.at() + i);
        store8(square.at() + i, vx * vx + vy * vy), store8(product.at() + i, vx * vy);
      }
      Piece* const pieces[4] = {&x, &y, &square, &product};
      for (int m = 0; m < 4; ++m) ring.put(row, m, [&](float* out) { filter_row(pieces[m]->at(), out, band.n); });
    }
    const int center = row - kRadius;
    if (center < band.y0) continue;
    const float* top[4];
    for (int m = 0; m < 4; ++m) top[m] = ring.window(center, m);
    const int64_t at = static_cast<int64_t>(center) * band.width + band.x0;
    d8 sum = {};
    for (int i = 0; i < band.n; i += 8) {
      f8 d[3];
      const f8 ssim = ssim_partials(ring.filter(top[0], i), ring.filter(top[1], i), ring.filter(top[2], i), ring.filter(top[3], i), d[0], d[1], d[2]);
      const int live = band.n - i < 8 ? band.n - i : 8;
      accumulate(sum, ssim, live);
      for (int m = 0; m < 3; ++m) {
        if (live == 8) store8(maps[m] + at + i, d[m]);
        else for (int l = 0; l < live; ++l) maps[m][at + i + l] = d[m][l];
      }
    }
    row_ssim[center] = total(sum);
  }
}

// Pass 2: the window is symmetric, so its transpose is itself: v = F(d_mean) + 2 x F(d_square) + y F(d_product).
inline void gradient_band(const PhotometricArguments& a, const Band& band, float* const maps[3], double* row_l1) {
  Ring<3> ring;
  Piece piece;
  const double count = static_cast<double>(band.width) * band.height;
  const f8 w_l1 = splat<f8>(static_cast<float>((1.0 - a.lambda_dssim) / count)), w_ssim = splat<f8>(static_cast<float>(-a.lambda_dssim / count));
  const f8 zero = splat<f8>(0.f);
  for (int row = band.y0 - kRadius; row < band.y1 + kRadius; ++row) {
    for (int m = 0; m < 3; ++m) {
      if (row < 0 || row >= band.height) {
        ring.put(row, m, [](float* out) { std::memset(out, 0, sizeof(float) * kStrip); });
      } else {
        piece.load(maps[m] + static_cast<int64_t>(row) * band.width, band.width, band.x0, band.n);
        ring.put(row, m, [&](float* out) { filter_row(piece.at(), out, band.n); });
      }
    }
    const int center = row - kRadius;
    if (center < band.y0) continue;
    const float* top[3];
    for (int m = 0; m < 3; ++m) top[m] = ring.window(center, m);
    const int64_t at = static_cast<int64_t>(center) * band.width + band.x0;
    d8 sum = {};
    for (int i = 0; i < band.n; i += 8) {
      const int live = band.n - i < 8 ? band.n - i : 8;
      f8 x = zero, y = zero;
      if (live == 8) x = load8(a.rendered + at + i), y = load8(a.target + at + i);
      else for (int l = 0; l < live; ++l) x[l] = a.rendered[at + i + l], y[l] = a.target[at + i + l];
      const f8 difference = x - y;
      accumulate(sum, abs(difference), live);
      const f8 sign = select(difference > 0.f, w_l1, select(difference < 0.f, zero - w_l1, zero));
      const f8 g = ring.filter(top[0], i) + x * 2.f * ring.filter(top[1], i) + y * ring.filter(top[2], i);
      const f8 v = sign + w_ssim * g;
      if (live == 8) store8(a.v_rendered + at + i, v);
      else for (int l = 0; l < live; ++l) a.v_rendered[at + i + l] = v[l];
    }
    row_l1[center] = total(sum);
  }
}

inline void photometric_stage(Pool& pool, PhotometricArguments& a) {
  const int width = 3 * a.width, strips = divide_up(width, kStrip), bands = pool.threads() == 1 ? 1 : 2 * pool.threads();
  const int64_t size = static_cast<int64_t>(width) * a.height, padded = (size + 15) / 16 * 16;
  a.scratch->reserve(sizeof(float) * 3 * padded + sizeof(double) * 2 * strips * a.height);
  float* maps[3];
  for (int m = 0; m < 3; ++m) maps[m] = a.scratch->as<float>() + m * padded;
  double* sums = reinterpret_cast<double*>(a.scratch->as<float>() + 3 * padded);
  const auto band = [&](int item) -> Band {
    const int strip = item % strips, b = item / strips, x0 = strip * kStrip;
    return {static_cast<int>(static_cast<int64_t>(a.height) * b / bands), static_cast<int>(static_cast<int64_t>(a.height) * (b + 1) / bands),
            x0, width - x0 < kStrip ? width - x0 : kStrip, width, a.height};
  };
  double *ssim = sums, *l1 = sums + static_cast<int64_t>(strips) * a.height;
  parallel(pool, bands * strips, [&](int item, int) { ssim_band(a, band(item), maps, ssim + static_cast<int64_t>(item % strips) * a.height); });
  parallel(pool, bands * strips, [&](int item, int) { gradient_band(a, band(item), maps, l1 + static_cast<int64_t>(item % strips) * a.height); });
  a.ssim = a.l1 = 0;
  for (int64_t k = 0; k < static_cast<int64_t>(strips) * a.height; ++k) a.ssim += ssim[k], a.l1 += l1[k];
  a.ssim /= static_cast<double>(size), a.l1 /= static_cast<double>(size);
}

}  // namespace gsopt::GSOPT_ISA
