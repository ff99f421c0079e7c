// Where two images differ, and how far that reaches: what a window of the loss has to look at.
//
// Behind a masked object image and render are the same background, SSIM is 1 there and has no gradient. Rows of images
// are taken in pairs, as the loss filters them; each pair has one interval of floats in which the images differ.
#pragma once
#include <algorithm>

#include "parallel.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

// Floats [begin, end) of a row.
struct Interval {
  int begin = 0, end = 0;
  bool empty() const { return begin >= end; }
  int length() const { return empty() ? 0 : end - begin; }
  // The least interval that holds both.
  Interval joined(Interval other) const {
    if (empty()) return other;
    return other.empty() ? *this : Interval{std::min(begin, other.begin), std::max(end, other.end)};
  }
  Interval clipped(int first, int last) const {
    const Interval both{std::max(begin, first), std::min(end, last)};
    return both.empty() ? Interval{first, first} : both;
  }
  // `by` floats more on either side, if it holds any.
  Interval grown(int by) const { return empty() ? *this : Interval{begin - by, end + by}; }
  // Whole vectors, counted from `first` on, and the last of them no longer than up to `last`.
  Interval of_vectors(int first, int last) const {
    if (empty()) return {first, first};
    return {first + (begin - first) / kWide * kWide, std::min(last, first + divide_up(end - first, kWide) * kWide)};
  }
};

// The floats in which two rows of `n` differ; a NaN differs from everything.
inline Interval differing(const float* a, const float* b, int n) {
  int begin = 0, end = n;
  const auto alike = [&](int i) { return !any(load_wide(a + i) != load_wide(b + i)); };
  while (begin + kWide <= end && alike(begin)) begin += kWide;
  while (begin < end && a[begin] == b[begin]) ++begin;
  while (begin + kWide <= end && alike(end - kWide)) end -= kWide;
  while (begin < end && a[end - 1] == b[end - 1]) --end;
  return {begin, end};
}

// The same of rows [y0, y1) of two images of `width` floats.
inline Interval differing_rows(const float* a, const float* b, int y0, int y1, int width) {
  Interval all;
  for (int64_t y = y0; y < y1; ++y) all = all.joined(differing(a + y * width, b + y * width, width));
  return all;
}

// That of every pair of rows within `reach` pairs of each, joined and `by` floats wider: what a window reaches from
// there.
inline void reached(const Interval* differ, Interval* out, int pairs, int reach, int by, int width) {
  for (int p = 0; p < pairs; ++p) {
    Interval all;
    for (int q = std::max(0, p - reach); q <= std::min(pairs - 1, p + reach); ++q) all = all.joined(differ[q]);
    out[p] = all.grown(by).clipped(0, width);
  }
}

}  // namespace gsopt::GSOPT_ISA
