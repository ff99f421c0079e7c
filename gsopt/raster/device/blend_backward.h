// The gradient of compositing, back to front (docs/math.md, 9 to 11). One block, one segment of a tile's list: what
// lies behind a segment is what all of the list adds to a pixel, less what it added up to there (as Mallick et al.
// 2024, "Taming 3DGS", have it for groups of 32).
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
  GLOBAL const int *last, *tile_of;    // as in BlendArguments; -1: nothing to do
  GLOBAL const float* ends;
  GLOBAL const float *v_colors, *v_alphas, *v_depths;  // the last two may be null
  GLOBAL Sums* sums;                                   // [slots]
};

constexpr int kGroup = 4 * kBatch;        // splats that a block reads at a time
constexpr int kPitch = kThreads + kTile;  // so that two splats' pixels lie in different banks
static_assert(kThreads >= kBatch * kTile, "a thread for every splat and column");

// A pixel's way back.
struct Pull {
  float T, behind, r, g, b, depth;
  int last;
};

inline End end_of(GLOBAL const float* ends, int segment, int t) {
  GLOBAL const float* at = ends + static_cast<Index>(segment) * kEndFields * kThreads + t;
  return {at[0], at[kThreads], at[2 * kThreads], at[3 * kThreads], at[4 * kThreads]};
}

// At the end of a segment, `all` being the end of the list.
inline Pull pull_of(const BlendBackwardArguments& a, Index at, End here, End all) {
  const Vec3<float> g = load3(a.v_colors, at);
  const float depth = a.v_depths ? a.v_depths[at] : 0.f, alpha = a.v_alphas ? a.v_alphas[at] : 0.f;
  const float background = g.x * a.background[0] + g.y * a.background[1] + g.z * a.background[2] - alpha;
  const float later =
      g.x * (all.r - here.r) + g.y * (all.g - here.g) + g.z * (all.b - here.b) + depth * (all.depth - here.depth);
  return {here.T, later / here.T + all.T / here.T * background, g.x, g.y, g.z, depth, a.last[at]};
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

// Field t % kRowFields of splat t / kRowFields, over its columns.
inline float total(IN_BLOCK const Scratch& in, int t) {
  float sum = 0.f;
  for (int x = 0; x < kTile; ++x) sum += in.sums[t / kRowFields * kTile + x][t % kRowFields];
  return sum;
}

KERNEL(blend_backward, BlendBackwardArguments) {
  SHARED Row rows[kGroup];
  SHARED Index slots[kGroup];
  SHARED Scratch scratch;
  SHARED float g[4][kThreads];
  SHARED int deepest;
  Own<Pull> pull;
  Own<Sums> column;
  const int number = a.tile_of[block()];
  if (number < 0) return;
  const Tile tile(number, a.tiles_x, a.width, a.height);
  const int begin = a.tile_begin[number], end = a.tile_begin[number + 1], segment = first_segment(number, begin);
  const int start = (block() - segment) * kSegment;
  PHASE(t) {
    if (t == 0) deepest = 0;
  }
  PHASE(t) {
    if (tile.has(t)) shared_max(&deepest, a.last[tile.pixel(t)]);
  }
  PHASE(t) {  // what no pixel took
    if (start == 0)
      for (int k = begin + deepest + t; k < end; k += kThreads) a.sums[a.slots[k]] = {};
    pull[t] = {};
    if (deepest > start && tile.has(t))
      pull[t] =
          pull_of(a, tile.pixel(t), end_of(a.ends, block(), t), end_of(a.ends, segment + (deepest - 1) / kSegment, t));
    g[0][t] = pull[t].r;
    g[1][t] = pull[t].g;
    g[2][t] = pull[t].b;
    g[3][t] = pull[t].depth;
  }
  const int stop = deepest < start + kSegment ? deepest : start + kSegment;
  if (stop <= start) return;
  for (int group = start + (stop - 1 - start) / kGroup * kGroup; group >= start; group -= kGroup) {
    const int read = stop - group < kGroup ? stop - group : kGroup;
    PHASE(t) {
      if (t < read) {
        rows[t] = row_of(a.records[a.ids[begin + group + t]], tile);
        slots[t] = a.slots[begin + group + t];
      }
    }
    for (int first = (read - 1) / kBatch * kBatch; first >= 0; first -= kBatch) {
      const int n = read - first < kBatch ? read - first : kBatch;
      PHASE(t) { pull_splats(rows + first, n, group + first, t, pull[t], scratch); }
      PHASE(t) {
        if (t / kTile < n) column[t] = column_sums(rows[first + t / kTile], scratch, g, t / kTile, t % kTile);
      }
      PHASE(t) {
        if (t / kTile < n)
          for (int f = 0; f < kRowFields; ++f) scratch.sums[t][f] = column[t].at[f];
      }
      PHASE(t) {
        if (t < n * kRowFields) a.sums[slots[first + t / kRowFields]].at[t % kRowFields] = total(scratch, t);
      }
    }
  }
}

}  // namespace gsopt::GSOPT_ISA
