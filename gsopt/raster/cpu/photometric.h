// (1 - lambda) L1 + lambda (1 - SSIM) and its gradient, fused (docs/math.md, section "SSIM").
//
// SSIM needs five filtered images; only the sum of the two variances enters, so four do: x, y, x² + y², x y. The
// 11-tap window is separable: first down the columns, two rows of output at a time, so that each input is loaded once
// for both and the squares and products need no image of their own; then along the rows of interleaved RGB, where
// neighbors are three floats apart. Each row of a strip has its own sum, and these are added in double in one order: the
// same bits for any number of threads.
#pragma once
#include "frame.h"
#include "parallel.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

constexpr int kRadius = 5, kTaps = 2 * kRadius + 1, kStrip = 2400, kHalo = 3 * kRadius;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
// exp(-k² / (2 1.5²)), normalised over k = -5..5; index = |k|.
constexpr float kWindow[kRadius + 1] = {0.26601172f, 0.21300553f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};

// Weights of the twelve input rows y - 5 ... y + 6 in the output rows y and y + 1.
struct PairWindow {
  float at[kTaps + 1][2];
  constexpr PairWindow() : at() {
    for (int k = 0; k <= kTaps; ++k) {
      at[k][0] = k == kTaps ? 0.f : kWindow[k < kRadius ? kRadius - k : k - kRadius];
      at[k][1] = k == 0 ? 0.f : kWindow[k - 1 < kRadius ? kRadius - k + 1 : k - 1 - kRadius];
    }
  }
};
inline constexpr PairWindow kPairWindow;

// A rectangle of the image: rows [y0, y1), floats [x0, x0 + n) of rows of `width` floats.
struct Band {
  int y0, y1, x0, n, width, height;
};

// Two rows of `Maps` images filtered down the columns, for a strip and kHalo floats on either side; zeros outside.
template <int Maps> class Columns {
 public:
  explicit Columns(const Band& band) : b(band), first(b.x0 < kHalo ? 0 : b.x0 - kHalo), end(b.x0 + b.n + kHalo > b.width ? b.width : b.x0 + b.n + kHalo) {}

  // `combine(inputs, values)` makes the inputs of the maps from those of the images.
  template <int Images, class Combine> void fill(int y, const float* const (&images)[Images], Combine&& combine) {
    const int n = end - first < kLanes ? kLanes : end - first;
    const float* rows[Images][kTaps + 1];
    for (int m = 0; m < Images; ++m)
      for (int k = 0; k <= kTaps; ++k) rows[m][k] = row_of(images[m], y - kRadius + k, narrow[m][k]);
    for (int i = 0; i < n; i += kLanes) {
      const int at = i + kLanes <= n ? i : n - kLanes;  // the last vector overlaps its neighbor
      f8 sum[2][Maps] = {};
#pragma GCC unroll 12
      for (int k = 0; k <= kTaps; ++k) {
        f8 input[Images], value[Maps];
        for (int m = 0; m < Images; ++m) input[m] = load8(rows[m][k] + at);
        combine(input, value);
        for (int m = 0; m < Maps; ++m) sum[0][m] += value[m] * kPairWindow.at[k][0], sum[1][m] += value[m] * kPairWindow.at[k][1];
      }
      for (int r = 0; r < 2; ++r)
        for (int m = 0; m < Maps; ++m) store8(&data[r][m][first + at - b.x0 + kPad], sum[r][m]);
    }
  }

  // Along one of the two rows, at float i of the strip.
  f8 filter(int row, int map, int i) const {
    const float* center = &data[row][map][kPad + i];
    f8 sum = load8(center) * kWindow[0];
    for (int k = 1; k <= kRadius; ++k) sum += (load8(center - 3 * k) + load8(center + 3 * k)) * kWindow[k];
    return sum;
  }

 private:
  static constexpr int kPad = kHalo + 1, kStride = kStrip + 2 * kPad + 8;
  static constexpr float kNothing[kStride] = {};

  // A row of an image from `first` on: zeros above and below it, a copy that fills a vector where it is too narrow for one.
  const float* row_of(const float* image, int y, float copy[kLanes]) const {
    if (y < 0 || y >= b.height) return kNothing;
    const float* row = image + static_cast<int64_t>(y) * b.width + first;
    if (end - first >= kLanes) return row;
    return static_cast<const float*>(std::memcpy(copy, row, sizeof(float) * (end - first)));
  }

  const Band b;
  const int first, end;  // the floats of a row that the strip needs
  alignas(64) float data[2][Maps][kStride] = {};
  float narrow[3][kTaps + 1][kLanes] = {};
};

// Eight floats, or the first n of them and zeros.
inline f8 load_first(const float* p, int n) {
  if (n >= 8) return load8(p);
  f8 v = splat<f8>(0.f);
  for (int l = 0; l < n; ++l) v[l] = p[l];
  return v;
}
inline void store_first(float* p, f8 v, int n) {
  if (n >= 8) return store8(p, v);
  for (int l = 0; l < n; ++l) p[l] = v[l];
}

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

// The first n of eight floats, zeros instead of the others.
inline f8 first_of(f8 v, int n) {
  for (int l = n; l < kLanes; ++l) v[l] = 0.f;
  return v;
}

inline double total(f8 v) {
  double sum = 0;
  for (int l = 0; l < kLanes; ++l) sum += static_cast<double>(v[l]);
  return sum;
}

// Pass 1: SSIM and its partials (three maps of the image's size), over a band.
inline void ssim_band(const PhotometricArguments& a, Band b, float* const maps[3], double* row_ssim) {
  Columns<4> columns(b);
  for (int y = b.y0; y < b.y1; y += 2) {
    columns.fill(y, {a.rendered, a.target}, [](const f8* in, f8* value) {
      const f8 x = in[0], target = in[1];
      value[0] = x, value[1] = target, value[2] = x * x + target * target, value[3] = x * target;
    });
    for (int r = 0; r < 2 && y + r < b.y1; ++r) {
      const int64_t at = static_cast<int64_t>(y + r) * b.width + b.x0;
      float *mean = maps[0] + at, *square = maps[1] + at, *product = maps[2] + at;
      f8 sum = splat<f8>(0.f);
      for (int i = 0; i < b.n; i += kLanes) {
        f8 d[3];
        const f8 ssim = ssim_partials(columns.filter(r, 0, i), columns.filter(r, 1, i), columns.filter(r, 2, i), columns.filter(r, 3, i),
                                      d[0], d[1], d[2]);
        sum += first_of(ssim, b.n - i);
        store_first(mean + i, d[0], b.n - i), store_first(square + i, d[1], b.n - i), store_first(product + i, d[2], b.n - i);
      }
      row_ssim[y + r] = total(sum);
    }
  }
}

// Pass 2: the window is symmetric, so its transpose is itself: v = F(d_mean) + 2 x F(d_square) + y F(d_product).
inline void gradient_band(const PhotometricArguments& a, Band b, float* const maps[3], double* row_l1) {
  Columns<3> columns(b);
  const double count = static_cast<double>(b.width) * b.height;
  const f8 w_l1 = splat<f8>(static_cast<float>((1.0 - a.lambda_dssim) / count)), w_ssim = splat<f8>(static_cast<float>(-a.lambda_dssim / count));
  const f8 zero = splat<f8>(0.f);
  for (int y = b.y0; y < b.y1; y += 2) {
    columns.fill(y, {maps[0], maps[1], maps[2]}, [](const f8* in, f8* value) { for (int m = 0; m < 3; ++m) value[m] = in[m]; });
    for (int r = 0; r < 2 && y + r < b.y1; ++r) {
      const int64_t at = static_cast<int64_t>(y + r) * b.width + b.x0;
      f8 sum = splat<f8>(0.f);
      for (int i = 0; i < b.n; i += kLanes) {
        const f8 x = load_first(a.rendered + at + i, b.n - i), target = load_first(a.target + at + i, b.n - i), difference = x - target;
        sum += first_of(abs(difference), b.n - i);
        const f8 sign = select(difference > 0.f, w_l1, select(difference < 0.f, zero - w_l1, zero));
        const f8 g = columns.filter(r, 0, i) + x * 2.f * columns.filter(r, 1, i) + target * columns.filter(r, 2, i);
        store_first(a.v_rendered + at + i, sign + w_ssim * g, b.n - i);
      }
      row_l1[y + r] = total(sum);
    }
  }
}

inline void photometric_stage(Pool& pool, PhotometricArguments& a) {
  const int width = 3 * a.width, strip = divide_up(divide_up(width, divide_up(width, kStrip)), kLanes) * kLanes, strips = divide_up(width, strip);
  const int bands = pool.threads() == 1 ? 1 : 2 * pool.threads();
  const int rows = (a.height + 2 * bands - 1) / (2 * bands) * 2;  // even, so that no pair of rows is split
  const int64_t size = static_cast<int64_t>(width) * a.height, padded = (size + 15) / 16 * 16;
  a.scratch->reserve(sizeof(float) * 3 * padded + sizeof(double) * 2 * strips * a.height);
  float* maps[3];
  for (int m = 0; m < 3; ++m) maps[m] = a.scratch->as<float>() + m * padded;
  double* sums = reinterpret_cast<double*>(a.scratch->as<float>() + 3 * padded);
  const auto band = [&](int item) -> Band {
    const int x0 = item % strips * strip, y0 = item / strips * rows;
    return {y0 < a.height ? y0 : a.height, y0 + rows < a.height ? y0 + rows : a.height, x0, width - x0 < strip ? width - x0 : strip, width, a.height};
  };
  double *ssim = sums, *l1 = sums + static_cast<int64_t>(strips) * a.height;
  parallel(pool, bands * strips, [&](int item, int) { ssim_band(a, band(item), maps, ssim + static_cast<int64_t>(item % strips) * a.height); });
  parallel(pool, bands * strips, [&](int item, int) { gradient_band(a, band(item), maps, l1 + static_cast<int64_t>(item % strips) * a.height); });
  a.ssim = a.l1 = 0;
  for (int64_t k = 0; k < static_cast<int64_t>(strips) * a.height; ++k) a.ssim += ssim[k], a.l1 += l1[k];
  a.ssim /= static_cast<double>(size), a.l1 /= static_cast<double>(size);
}

}  // namespace gsopt::GSOPT_ISA
