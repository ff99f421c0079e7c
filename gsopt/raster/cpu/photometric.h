// (1 - lambda) L1 + lambda (1 - SSIM) and its gradient, fused (docs/math.md, 19 to 21).
//
// SSIM needs five filtered images; only the sum of the two variances enters, so four do: x, y, x² + y², x y. The
// 11-tap window is separable: first down the columns, two rows of output at a time, so that each input is loaded once
// for both and the squares and products need no image of their own; then along the rows of interleaved RGB, where
// neighbors are three floats apart. The gradient of SSIM is again a filtered image, five rows later: what it is made of
// waits for it in a ring of rows that stays in the cache. Each row of a strip has its own sum, and these are added in
// double in one order: the same bits for any number of threads.
//
// What no window reaches from a pixel in which the images differ has SSIM 1 and no gradient, and is left out.
#pragma once
#include "../common/ssim.h"
#include "frame.h"
#include "parallel.h"
#include "simd.h"
#include "intervals.h"

namespace gsopt::GSOPT_ISA {

constexpr int kStrip = 2400, kHalo = 3 * kRadius;
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
  // With what its filtered rows need around it; it begins at an even row, as every pair of rows does.
  Band grown() const {
    const int left = x0 < kHalo ? 0 : x0 - kHalo, right = x0 + n + kHalo > width ? width : x0 + n + kHalo;
    return {y0 < kRadius + 1 ? 0 : y0 - kRadius - 1, y1 + kRadius > height ? height : y1 + kRadius, left, right - left,
        width, height};
  }
};

// Rows of floats, all of them or the last kRing; the first of a row belongs to column x0 of the image.
constexpr int kRing = 16, kRingStride = kStrip + 2 * kHalo + 2;
struct Image {
  float* data;
  int64_t stride;
  int rows, x0;  // rows: a power of two, or more than there are
  float* at(int y, int x) const { return data + (y & (rows - 1)) * stride + (x - x0); }
};

// The sum of the vectors `Shift` floats before and behind `center`.
template <int Shift> inline wide both_sides(const float* center) {
#if defined(__AVX512F__)
  // Out of whole lines of the cache: loads that lie in two cost twice.
  const auto before = (__m512i)load_wide(center - kWide), here = (__m512i)load_wide(center),
             behind = (__m512i)load_wide(center + kWide);
  return (wide)_mm512_alignr_epi32(here, before, kWide - Shift) + (wide)_mm512_alignr_epi32(behind, here, Shift);
#else
  return load_wide(center - Shift) + load_wide(center + Shift);
#endif
}

// Two rows of `Maps` images filtered down the columns, for a strip and kHalo floats on either side; zeros outside.
template <int Maps> class Columns {
 public:
  explicit Columns(const Band& band) : b(band), first(b.grown().x0), end(first + b.grown().n) {}

  // What `filter` needs for the floats `part` of the rows. `combine(inputs, values)` makes the inputs of the maps from
  // those of the images.
  template <int Images, class Combine>
  void fill(int y, Interval part, const Image (&images)[Images], Combine&& combine) {
    if (part.empty()) return;
    const int n = end - first < kWide ? kWide : end - first;
    const float* rows[Images][kTaps + 1];
    for (int m = 0; m < Images; ++m)
      for (int k = 0; k <= kTaps; ++k) rows[m][k] = row_of(images[m], y - kRadius + k, narrow[m][k]);
    const int left = std::max(0, part.begin - kHalo - first) / kWide * kWide, right = part.end + kHalo - first;
    for (int i = left; i < std::min(n, right); i += kWide) {
      const int at = i + kWide <= n ? i : n - kWide;  // the last vector overlaps its neighbor
      wide sum[2][Maps] = {};
#pragma GCC unroll 12
      for (int k = 0; k <= kTaps; ++k) {
        wide input[Images], value[Maps];
        for (int m = 0; m < Images; ++m) input[m] = load_wide(rows[m][k] + at);
        combine(input, value);
        for (int m = 0; m < Maps; ++m) {
          sum[0][m] += value[m] * kPairWindow.at[k][0];
          sum[1][m] += value[m] * kPairWindow.at[k][1];
        }
      }
      for (int r = 0; r < 2; ++r)
        for (int m = 0; m < Maps; ++m) store_wide(&data[r][m][first + at - b.x0 + kPad], sum[r][m]);
    }
  }

  // Along one of the two rows, at float i of the strip.
  wide filter(int row, int map, int i) const {
    const float* center = &data[row][map][kPad + i];
    const wide sum =
        load_wide(center) * kWindow[0] + both_sides<3>(center) * kWindow[1] + both_sides<6>(center) * kWindow[2];
    return sum + both_sides<9>(center) * kWindow[3] + both_sides<12>(center) * kWindow[4] +
           both_sides<15>(center) * kWindow[5];
  }

 private:
  static constexpr int kPad = kHalo + 1, kStride = divide_up(kStrip + 2 * kHalo + 2 * kPad + kWide, 16) * 16;
  static constexpr float kNothing[kStride] = {};

  // A row of an image from `first` on: zeros above and below it, a copy that fills a vector where it is narrower.
  const float* row_of(const Image& image, int y, float copy[kWide]) const {
    if (y < 0 || y >= b.height) return kNothing;
    const float* row = image.at(y, first);
    if (end - first >= kWide) return row;
    return static_cast<const float*>(std::memcpy(copy, row, sizeof(float) * (end - first)));
  }

  const Band b;
  const int first, end;  // the floats of a row that the strip needs
  alignas(64) float data[2][Maps][kStride] = {};
  float narrow[3][kTaps + 1][kWide] = {};
};

// A vector of floats, or the first n of them and zeros.
inline wide load_first(const float* p, int n) {
  if (n >= kWide) return load_wide(p);
  wide v = splat<wide>(0.f);
  for (int l = 0; l < n; ++l) v[l] = p[l];
  return v;
}
inline void store_first(float* p, wide v, int n) {
  if (n >= kWide) return store_wide(p, v);
  for (int l = 0; l < n; ++l) p[l] = v[l];
}

// The first n floats of a vector, zeros instead of the others.
inline wide first_of(wide v, int n) {
  for (int l = n; l < kWide; ++l) v[l] = 0.f;
  return v;
}

inline double total(wide v) {
  double sum = 0;
  for (int l = 0; l < kWide; ++l) sum += static_cast<double>(v[l]);
  return sum;
}

// Two rows of SSIM's partials from y on, of the floats `part`, into three maps; SSIM itself, which is 1 elsewhere, is
// summed over rows and floats of `inner`.
inline void ssim_rows(Columns<4>& columns, const Band& b, int y, Interval part, const Image (&images)[2],
    const Image (&maps)[3], const Band& inner, double* row_ssim) {
  const Interval counted = part.clipped(inner.x0, inner.x0 + inner.n);
  columns.fill(y, part, images, [](const wide* in, wide* value) {
    const wide x = in[0], target = in[1];
    value[0] = x;
    value[1] = target;
    value[2] = x * x + target * target;
    value[3] = x * target;
  });
  for (int r = 0; r < 2 && y + r < b.y1; ++r) {
    float *mean = maps[0].at(y + r, b.x0), *square = maps[1].at(y + r, b.x0), *product = maps[2].at(y + r, b.x0);
    alignas(64) float ssim[kStrip + 2 * kHalo + kWide];
    for (int i = part.begin - b.x0; i < part.end - b.x0; i += kWide) {
      wide d[3];
      store_wide(ssim + i, ssim_partials(columns.filter(r, 0, i), columns.filter(r, 1, i), columns.filter(r, 2, i),
                               columns.filter(r, 3, i), d[0], d[1], d[2]));
      store_first(mean + i, d[0], b.n - i);
      store_first(square + i, d[1], b.n - i);
      store_first(product + i, d[2], b.n - i);
    }
    if (y + r < inner.y0 || y + r >= inner.y1) continue;
    wide sum = splat<wide>(0.f);
    for (int i = counted.begin; i < counted.end; i += kWide) sum += load_first(ssim + i - b.x0, counted.end - i);
    row_ssim[y + r] = total(sum) + inner.n - counted.length();
  }
}

// Two rows of the gradient from y on, 0 outside `part`. The window is symmetric, so its transpose is itself:
// v = F(d_mean) + 2 x F(d_square) + y F(d_product), (21).
inline void gradient_rows(Columns<3>& columns, const PhotometricArguments& a, const Band& b, int y, Interval part,
    const Image (&maps)[3], double* row_l1) {
  const double count = static_cast<double>(b.width) * b.height;
  const wide w_l1 = splat<wide>(static_cast<float>((1.0 - a.lambda_dssim) / count)),
             w_ssim = splat<wide>(static_cast<float>(-a.lambda_dssim / count));
  const wide zero = splat<wide>(0.f);
  columns.fill(y, part, maps, [](const wide* in, wide* value) {
    for (int m = 0; m < 3; ++m) value[m] = in[m];
  });
  for (int r = 0; r < 2 && y + r < b.y1; ++r) {
    const int64_t at = static_cast<int64_t>(y + r) * b.width + b.x0;
    const int begin = part.begin - b.x0, end = part.end - b.x0;
    std::memset(a.v_rendered + at, 0, sizeof(float) * begin);
    std::memset(a.v_rendered + at + end, 0, sizeof(float) * (b.n - end));
    wide sum = zero;
    for (int i = begin; i < end; i += kWide) {
      const wide x = load_first(a.rendered + at + i, b.n - i), target = load_first(a.target + at + i, b.n - i),
                 difference = x - target;
      sum += first_of(abs(difference), b.n - i);
      const wide sign = select(difference > 0.f, w_l1, select(difference < 0.f, zero - w_l1, zero));
      const wide g = columns.filter(r, 0, i) + x * 2.f * columns.filter(r, 1, i) + target * columns.filter(r, 2, i);
      store_first(a.v_rendered + at + i, sign + w_ssim * g, b.n - i);
    }
    row_l1[y + r] = total(sum);
  }
}

// Where a strip has a gradient in two rows from an even y on: whole vectors. `near`: that of every pair of whole rows.
inline Interval with_gradient(const Band& b, const Interval* near, int y) {
  return near[y / 2].clipped(b.x0, b.x0 + b.n).of_vectors(b.x0, b.x0 + b.n);
}

// Where such a gradient needs the partials of two rows from y on, in the strip and what lies `around` it.
inline Interval with_partials(const Band& b, const Band& around, const Interval* near, int y) {
  Interval all;
  for (int from = std::max(0, y - kRadius - 1); from < std::min(b.height, y + kRadius + 2); from += 2)
    all = all.joined(with_gradient(b, near, from));
  const int end = around.x0 + around.n;
  return all.grown(kHalo).clipped(around.x0, end).of_vectors(around.x0, end);
}

// The partials run ahead of the gradient by the rows that its window reaches.
inline void photometric_band(
    const PhotometricArguments& a, const Band& b, const Interval* near, float* ring, double* row_ssim, double* row_l1) {
  const Band around = b.grown();
  const int64_t stride = kRingStride;
  const Image images[2] = {
      {const_cast<float*>(a.rendered), b.width, 1 << 30, 0}, {const_cast<float*>(a.target), b.width, 1 << 30, 0}};
  const Image maps[3] = {{ring, stride, kRing, around.x0}, {ring + kRing * stride, stride, kRing, around.x0},
      {ring + 2 * kRing * stride, stride, kRing, around.x0}};
  Columns<4> ahead(around);
  Columns<3> columns(b);
  int next = around.y0;
  for (int y = b.y0; y < b.y1; y += 2) {
    for (; next < around.y1 && next <= y + 1 + kRadius; next += 2)
      ssim_rows(ahead, around, next, with_partials(b, around, near, next), images, maps, b, row_ssim);
    gradient_rows(columns, a, b, y, with_gradient(b, near, y), maps, row_l1);
  }
}

inline void photometric_stage(Pool& pool, PhotometricArguments& a) {
  const int width = 3 * a.width, strip = divide_up(divide_up(width, divide_up(width, kStrip)), kWide) * kWide,
            strips = divide_up(width, strip);
  const int bands = pool.threads() == 1 ? 1 : 2 * pool.threads();
  const int rows = (a.height + 2 * bands - 1) / (2 * bands) * 2;  // even, so that no pair of rows is split
  constexpr int64_t kRingFloats = 3 * kRing * kRingStride;
  const int pairs = divide_up(a.height, 2);
  a.scratch->reserve(sizeof(float) * kRingFloats * pool.threads() + sizeof(double) * 2 * strips * a.height +
                     sizeof(Interval) * 2 * pairs);
  double *ssim = reinterpret_cast<double*>(a.scratch->as<float>() + kRingFloats * pool.threads()),
         *l1 = ssim + static_cast<int64_t>(strips) * a.height;
  Interval *differ = reinterpret_cast<Interval*>(l1 + static_cast<int64_t>(strips) * a.height), *near = differ + pairs;
  parallel(pool, bands, [&](int item, int) {
    for (int y = item * rows; y < std::min(a.height, (item + 1) * rows); y += 2)
      differ[y / 2] = differing_rows(a.rendered, a.target, y, std::min(y + 2, a.height), width);
  });
  reached(differ, near, pairs, kRadius, 2 * kHalo, width);
  parallel(pool, bands * strips, [&](int item, int worker) {
    const int x0 = item % strips * strip, y0 = item / strips * rows;
    const Band band = {
        y0, y0 + rows < a.height ? y0 + rows : a.height, x0, width - x0 < strip ? width - x0 : strip, width, a.height};
    const int64_t sums = static_cast<int64_t>(item % strips) * a.height;
    float* ring = a.scratch->as<float>() + kRingFloats * worker;
    if (y0 < a.height) photometric_band(a, band, near, ring, ssim + sums, l1 + sums);
  });
  a.ssim = a.l1 = 0;
  for (int64_t k = 0; k < static_cast<int64_t>(strips) * a.height; ++k) {
    a.ssim += ssim[k];
    a.l1 += l1[k];
  }
  const double size = static_cast<double>(width) * a.height;
  a.ssim /= size;
  a.l1 /= size;
}

}  // namespace gsopt::GSOPT_ISA
