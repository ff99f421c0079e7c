// (1 - lambda) L1 + lambda (1 - SSIM) and its gradient (docs/math.md, 19 to 21). One block, one channel of one tile.
#pragma once
#include "frame.h"

namespace gsopt::GSOPT_ISA {

struct PhotometricArguments {
  int width, height, tiles_x, tiles;
  float weight_l1, weight_ssim;  // of the sum over pixels and channels
  GLOBAL const float *rendered, *target;
  GLOBAL float *d_mean, *d_square, *d_product;  // [H,W,3], (20)
  GLOBAL float* sums;                           // [3 tiles, 2]: of |x - y| and of SSIM, one block each
  GLOBAL float* v_rendered;
};

constexpr int kHalo = kTile + 2 * kRadius;
constexpr int kRows = kHalo * kTile;  // numbers of a map filtered along the rows: kHalo rows of kTile columns

// The tile of a block and its channel: the blocks of one tile are neighbors.
struct Channel {
  int x, y, width, height, channel;
  Channel(int block, const PhotometricArguments& a)
      : x(block / 3 % a.tiles_x * kTile), y(block / 3 / a.tiles_x * kTile), width(a.width), height(a.height),
        channel(block % 3) {}
  bool has(int column, int row) const {
    return x + column >= 0 && x + column < width && y + row >= 0 && y + row < height;
  }
  Index at(int column, int row) const { return (static_cast<Index>(y + row) * width + x + column) * 3 + channel; }
  // Number i of the tile and what a window around its pixels needs; zero outside the image.
  float near(GLOBAL const float* image, int i) const {
    const int column = i % kHalo - kRadius, row = i / kHalo - kRadius;
    return has(column, row) ? image[at(column, row)] : 0.f;
  }
};

inline float window_at(int k) { return kWindow[k < kRadius ? kRadius - k : k - kRadius]; }

// Down the column of thread t.
inline float filtered(IN_BLOCK const float* rows, int t) {
  float sum = 0.f;
  for (int k = 0; k < kTaps; ++k) sum += rows[(t / kTile + k) * kTile + t % kTile] * window_at(k);
  return sum;
}

// The sums of two numbers of every thread, in one order; into to[0] and to[1].
struct Totals {
  float l1[kThreads], ssim[kThreads];
};

inline void filter_images(IN_BLOCK const float* x, IN_BLOCK const float* y, int i, IN_BLOCK float (*out)[kRows]) {
  const int from = i / kTile * kHalo + i % kTile;
  float mx = 0.f, my = 0.f, square = 0.f, product = 0.f;
  for (int k = 0; k < kTaps; ++k) {
    const float w = window_at(k), a = x[from + k], b = y[from + k];
    mx += w * a;
    my += w * b;
    square += w * (a * a + b * b);
    product += w * (a * b);
  }
  out[0][i] = mx;
  out[1][i] = my;
  out[2][i] = square;
  out[3][i] = product;
}

KERNEL(ssim_of_tiles, PhotometricArguments) {
  SHARED float x[kHalo * kHalo], y[kHalo * kHalo];
  SHARED float rows[4][kRows];
  SHARED Totals totals;
  const Channel tile(block(), a);
  PHASE(t) {
    for (int i = t; i < kHalo * kHalo; i += kThreads) {
      x[i] = tile.near(a.rendered, i);
      y[i] = tile.near(a.target, i);
    }
  }
  PHASE(t) {
    for (int i = t; i < kRows; i += kThreads) filter_images(x, y, i, rows);
  }
  PHASE(t) {
    totals.l1[t] = totals.ssim[t] = 0.f;
    if (tile.has(t % kTile, t / kTile)) {
      const Index at = tile.at(t % kTile, t / kTile);
      const int here = (t / kTile + kRadius) * kHalo + t % kTile + kRadius;
      totals.l1[t] = abs(x[here] - y[here]);
      float d_mean, d_square, d_product;
      totals.ssim[t] = ssim_partials(filtered(rows[0], t), filtered(rows[1], t), filtered(rows[2], t),
          filtered(rows[3], t), d_mean, d_square, d_product);
      a.d_mean[at] = d_mean;
      a.d_square[at] = d_square;
      a.d_product[at] = d_product;
    }
  }
  for (int rest = kThreads / 2; rest > 0; rest /= 2) {
    PHASE(t) {
      if (t < rest) {
        totals.l1[t] += totals.l1[t + rest];
        totals.ssim[t] += totals.ssim[t + rest];
      }
    }
  }
  PHASE(t) {
    if (t == 0) {
      a.sums[2 * block()] = totals.l1[0];
      a.sums[2 * block() + 1] = totals.ssim[0];
    }
  }
}

// The window is symmetric, so its transpose is itself: (21).
KERNEL(ssim_gradient, PhotometricArguments) {
  SHARED float maps[3][kHalo * kHalo];
  SHARED float rows[3][kRows];
  const Channel tile(block(), a);
  PHASE(t) {
    for (int i = t; i < kHalo * kHalo; i += kThreads) {
      maps[0][i] = tile.near(a.d_mean, i);
      maps[1][i] = tile.near(a.d_square, i);
      maps[2][i] = tile.near(a.d_product, i);
    }
  }
  PHASE(t) {
    for (int i = t; i < 3 * kRows; i += kThreads) {
      const int map = i / kRows, at = i % kRows, from = at / kTile * kHalo + at % kTile;
      float sum = 0.f;
      for (int k = 0; k < kTaps; ++k) sum += window_at(k) * maps[map][from + k];
      rows[map][at] = sum;
    }
  }
  PHASE(t) {
    if (tile.has(t % kTile, t / kTile)) {
      const Index at = tile.at(t % kTile, t / kTile);
      const float x = a.rendered[at], y = a.target[at], difference = x - y;
      const float sign = difference > 0.f ? a.weight_l1 : (difference < 0.f ? -a.weight_l1 : 0.f);
      const float pull = filtered(rows[0], t) + x * 2.f * filtered(rows[1], t) + y * filtered(rows[2], t);
      a.v_rendered[at] = sign - a.weight_ssim * pull;
    }
  }
}

}  // namespace gsopt::GSOPT_ISA
