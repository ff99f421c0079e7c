// The gradient of compositing, back to front (docs/math.md, 9 to 11). One block, one tile.
//
// A few splats at a time: first a thread is a pixel and finds what each of these splats pulls at it, then a thread is a
// splat and a column of pixels and adds up. Every (splat, tile) pair has a row of sums of its own, which one thread
// writes: no two threads add to one number, so the bits are the same run after run.
#pragma once
#include "frame.h"

namespace gsopt::GSOPT_ISA {

struct BlendBackwardArguments {
  int width, height, tiles_x;
  float background[3];
  GLOBAL const Record* records;
  GLOBAL const int *tile_begin, *ids;  // as in BlendArguments
  GLOBAL const Index* slots;           // [entries] where the row of an entry goes
  GLOBAL const float* transmittance;
  GLOBAL const int* last;
  GLOBAL const float *v_colors, *v_alphas, *v_depths;  // the last two may be null
  GLOBAL Sums* sums;                                   // [slots]
};

constexpr int kPitch = kThreads + kTile;  // so that two splats' pixels lie in different banks
static_assert(kThreads >= kBatch * kTile, "a thread for every splat and column");

// A pixel's way back.
struct Pull {
  float T, behind, r, g, b, depth;
  int last;
};

inline Pull pull_of(const BlendBackwardArguments& a, Index at) {
  const Vec3<float> g = load3(a.v_colors, at);
  const float behind = g.x * a.background[0] + g.y * a.background[1] + g.z * a.background[2];
  return {a.transmittance[at], behind - (a.v_alphas ? a.v_alphas[at] : 0.f), g.x, g.y, g.z,
      a.v_depths ? a.v_depths[at] : 0.f, a.last[at]};
}

// What the splats of a batch are at every pixel; then, in the same memory, the sums of every thread.
union Scratch {
  struct {
    float weight[kBatch][kPitch], s[kBatch][kPitch];
  } at;
  float sums[kBatch * kTile][kRowFields + 1];
};

inline void pull_splats(IN_BLOCK const Row* rows, int n, int first, int t, Pull& p, IN_BLOCK Scratch& out) {
  const float X = pixel_x(t), Y = pixel_y(t);
  for (int j = n - 1; j >= 0; --j) {
    Whitened<float> at;
    IN_BLOCK const Row& row = rows[j];
    const Spread<float> splat = spread(row);
    const float alpha = first + j < p.last ? alpha_of(exponent(splat, X, Y, at)) : 0.f;
    out.at.weight[j][t] = out.at.s[j][t] = 0.f;
    if (!(alpha > 0.f)) continue;
    const float q = row.r * p.r + row.g * p.g + row.b * p.b + row.depth * p.depth;
    const Passed<float> now = passed(alpha, q, p.T, p.behind);
    p.T = now.T;
    p.behind = now.behind;
    out.at.weight[j][t] = now.weight;
    out.at.s[j][t] = now.s;
  }
}

// The sums (10) and (11) of splat j over column x of the tile; `g` holds the pixels' gradients.
inline Sums column_sums(
    IN_BLOCK const Row& row, IN_BLOCK const Scratch& in, IN_BLOCK const float (*g)[kThreads], int j, int x) {
  const Spread<float> splat = spread(row);
  Sums out = {};
  for (int y = 0; y < kTile; ++y) {
    const int t = y * kTile + x;
    const float weight = in.at.weight[j][t], s = in.at.s[j][t];
    Whitened<float> at;
    exponent(splat, pixel_x(t), pixel_y(t), at);
    const float su = s * at.u, sv = s * at.v;
    out.at[kS] += s;
    out.at[kSu] += su;
    out.at[kSv] += sv;
    out.at[kSuu] += su * at.u;
    out.at[kSuv] += su * at.v;
    out.at[kSvv] += sv * at.v;
    out.at[kWr] += weight * g[0][t];
    out.at[kWg] += weight * g[1][t];
    out.at[kWb] += weight * g[2][t];
    out.at[kWz] += weight * g[3][t];
    out.at[kAbsX] += abs(su);
    out.at[kAbsY] += abs(row.B * su + row.C * sv);
  }
  out.at[kAbsX] *= row.A * (1.f / kHalfLog2E);
  out.at[kAbsY] *= 1.f / kHalfLog2E;
  return out;
}

KERNEL(blend_backward, BlendBackwardArguments) {
  SHARED Row rows[kBatch];
  SHARED Scratch scratch;
  SHARED float g[4][kThreads];
  SHARED int deepest;
  Own<Pull> pull;
  Own<Sums> column;
  const Tile tile(block(), a.tiles_x, a.width, a.height);
  const int begin = a.tile_begin[block()], end = a.tile_begin[block() + 1];
  PHASE(t) {
    if (t == 0) deepest = 0;
    if (tile.has(t)) {
      pull[t] = pull_of(a, tile.pixel(t));
    } else {
      pull[t] = {};
    }
    g[0][t] = pull[t].r;
    g[1][t] = pull[t].g;
    g[2][t] = pull[t].b;
    g[3][t] = pull[t].depth;
  }
  PHASE(t) { shared_max(&deepest, pull[t].last); }
  PHASE(t) {  // what no pixel took
    for (int k = begin + deepest + t; k < end; k += kThreads) a.sums[a.slots[k]] = {};
  }
  for (int first = (deepest + kBatch - 1) / kBatch * kBatch - kBatch; first >= 0; first -= kBatch) {
    const int n = deepest - first < kBatch ? deepest - first : kBatch;
    PHASE(t) {
      if (t < n) rows[t] = row_of(a.records[a.ids[begin + first + t]], tile);
    }
    PHASE(t) { pull_splats(rows, n, first, t, pull[t], scratch); }
    PHASE(t) {
      if (t / kTile < n) column[t] = column_sums(rows[t / kTile], scratch, g, t / kTile, t % kTile);
    }
    PHASE(t) {
      if (t / kTile < n)
        for (int f = 0; f < kRowFields; ++f) scratch.sums[t][f] = column[t].at[f];
    }
    PHASE(t) {
      if (t < n * kRowFields) {
        const int j = t / kRowFields, f = t % kRowFields;
        float sum = 0.f;
        for (int x = 0; x < kTile; ++x) sum += scratch.sums[j * kTile + x][f];
        a.sums[a.slots[begin + first + j]].at[f] = sum;
      }
    }
  }
}

}  // namespace gsopt::GSOPT_ISA
