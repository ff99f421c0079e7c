// Front-to-back compositing (docs/math.md, 7 and 8). One block, one tile; one thread, one pixel.
#pragma once
#include "frame.h"

namespace gsopt::GSOPT_ISA {

struct BlendArguments {
  int width, height, tiles_x;
  float background[3];
  GLOBAL const Record* records;
  GLOBAL const int *tile_begin, *ids;      // [tiles + 1] first entry of a tile; [entries] the splat of an entry
  GLOBAL float *colors, *alphas, *depths;  // depths may be null
  GLOBAL int* last;                        // [pixels] number in its tile, from 1, of the last splat that a pixel took
  GLOBAL float* ends;                      // [segments, kEndFields, kThreads]
  GLOBAL int* tile_of;                     // [segments]; stays as it is for those that no pixel needs
};

struct Pixel {
  float T, r, g, b, depth;
  int last;
};

inline void write_end(GLOBAL float* ends, int segment, int t, const Pixel& p) {
  GLOBAL float* to = ends + static_cast<Index>(segment) * kEndFields * kThreads + t;
  to[0] = p.T;
  to[kThreads] = p.r;
  to[2 * kThreads] = p.g;
  to[3 * kThreads] = p.b;
  to[4 * kThreads] = p.depth;
}

// The splats of a chunk, `first` being how many of the tile came before.
inline void blend_pixel(IN_BLOCK const Row* rows, int n, int first, int t, Pixel& p) {
  const float X = pixel_x(t), Y = pixel_y(t);
  for (int i = 0; i < n && p.T > kTransmittanceMin; ++i) {
    Whitened<float> at;
    const Spread<float> splat = spread(rows[i]);
    const float alpha = alpha_of(exponent(splat, X, Y, at)), weight = alpha * p.T;
    if (!(alpha > 0.f)) continue;
    p.r += rows[i].r * weight;
    p.g += rows[i].g * weight;
    p.b += rows[i].b * weight;
    p.depth += rows[i].depth * weight;
    p.T -= weight;
    p.last = first + i + 1;
  }
}

inline void write_pixel(const BlendArguments& a, Index at, const Pixel& p) {
  store3(a.colors, at, {p.r + p.T * a.background[0], p.g + p.T * a.background[1], p.b + p.T * a.background[2]});
  a.alphas[at] = 1.f - p.T;
  if (a.depths) a.depths[at] = p.depth;
  a.last[at] = p.last;
}

KERNEL(blend, BlendArguments) {
  SHARED Row rows[kSegment];
  SHARED int scratch;
  Own<Pixel> pixel;
  Own<bool> done;
  const Tile tile(block(), a.tiles_x, a.width, a.height);
  const int begin = a.tile_begin[block()], end = a.tile_begin[block() + 1];
  int segment = first_segment(block(), begin);
  PHASE(t) {
    pixel[t] = {1.f, 0.f, 0.f, 0.f, 0.f, 0};
    done[t] = !tile.has(t);
  }
  for (int first = begin; first < end && !all_threads(done, &scratch); first += kSegment, ++segment) {
    const int n = end - first < kSegment ? end - first : kSegment;
    PHASE(t) {
      if (t < n) rows[t] = row_of(a.records[a.ids[first + t]], tile);
    }
    PHASE(t) {
      if (!done[t]) blend_pixel(rows, n, first - begin, t, pixel[t]);
      done[t] = done[t] || !(pixel[t].T > kTransmittanceMin);
      write_end(a.ends, segment, t, pixel[t]);
      if (t == 0) a.tile_of[segment] = block();
    }
  }
  PHASE(t) {
    if (tile.has(t)) write_pixel(a, tile.pixel(t), pixel[t]);
  }
}

}  // namespace gsopt::GSOPT_ISA
