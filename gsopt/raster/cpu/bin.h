// Stage 2: visible splats sorted front to back (stable radix sort on depth), then listed per tile in that order.
// A splat enters a tile only when its ellipse alpha >= 1/255 reaches a pixel centre there (up to a small margin).
#pragma once
#include "frame.h"
#include "parallel.h"
#include "simd.h"

namespace gsopt::GSOPT_ISA {

constexpr int kRadixBits = 11, kRadix = 1 << kRadixBits;
constexpr int kSortChunk = 1 << 15;
constexpr int kAhead = 16;  // splats are visited in depth order, that is anywhere in memory: ask for them early

// Least significant digit first, 3 passes of 11 bits; chunks of the input keep their order, so ties go by index.
inline void sort_stage(Pool& pool, Frame& frame) {
  const int64_t n = frame.visible;
  const int chunks = divide_up(n, kSortChunk);
  Buffer *keys[2] = {&frame.keys, &frame.keys2}, *ids[2] = {&frame.order, &frame.order2};
  uint32_t* histogram = frame.histogram.as<uint32_t>();
  for (int pass = 0; pass < 3; ++pass) {
    const int shift = pass * kRadixBits, from = pass & 1;
    const uint32_t *key = keys[from]->as<uint32_t>(), *id = ids[from]->as<uint32_t>();
    uint32_t *key_out = keys[1 - from]->as<uint32_t>(), *id_out = ids[1 - from]->as<uint32_t>();
    const auto range = [&](int chunk, int64_t& begin, int64_t& end) {
      begin = static_cast<int64_t>(chunk) * kSortChunk;
      end = begin + kSortChunk < n ? begin + kSortChunk : n;
    };
    parallel(pool, chunks, [&](int chunk, int) {
      uint32_t* h = histogram + static_cast<int64_t>(chunk) * kRadix;
      std::memset(h, 0, sizeof(uint32_t) * kRadix);
      int64_t begin, end;
      range(chunk, begin, end);
      for (int64_t i = begin; i < end; ++i) ++h[key[i] >> shift & (kRadix - 1)];
    });
    uint32_t sum = 0;
    for (int digit = 0; digit < kRadix; ++digit) {
      for (int chunk = 0; chunk < chunks; ++chunk) {
        uint32_t& h = histogram[static_cast<int64_t>(chunk) * kRadix + digit];
        const uint32_t count = h;
        h = sum, sum += count;
      }
    }
    parallel(pool, chunks, [&](int chunk, int) {
      uint32_t* h = histogram + static_cast<int64_t>(chunk) * kRadix;
      int64_t begin, end;
      range(chunk, begin, end);
      for (int64_t i = begin; i < end; ++i) {
        const uint32_t to = h[key[i] >> shift & (kRadix - 1)]++;
        key_out[to] = key[i], id_out[to] = id[i];
      }
    });
  }
}  // an odd number of passes: the sorted ids are in order2

// Calls visit(tile) for every tile that the splat's ellipse reaches, row by row.
template <class Visit> inline void for_each_tile(const Frame& frame, const Record& r, Visit&& visit) {
  if (r.x1 - r.x0 <= 1 || r.y1 - r.y0 <= 1) {  // a row or a column of tiles: the box is good enough
    for (int y = r.y0; y < r.y1; ++y)
      for (int x = r.x0; x < r.x1; ++x) visit(y * frame.tiles_x + x);
    return;
  }
  // (A x + B y)² + (C y)² = t bounds the ellipse; over a strip of rows its right end is at the strip's nearest y to
  // the rightmost point's, y_r = -B/C sqrt(t / (B² + C²)); its left end mirrors that.
  const float t = (r.log2_opacity - kLog2AlphaMin) * 1.0001f + 1e-3f;
  const float iA = 1.f / r.A, slope = r.B * iA;
  const float extreme = -(r.B / r.C) * __builtin_sqrtf(t / (r.B * r.B + r.C * r.C));
  const auto limit = [](float v, float lo, float hi) { return v < lo ? lo : (v > hi ? hi : v); };
  for (int y = r.y0; y < r.y1; ++y) {
    const float top = static_cast<float>(y * kTile) + 0.5f - r.my, bottom = top + (kTile - 1);
    const float yr = limit(extreme, top, bottom), yl = limit(-extreme, top, bottom);
    const float sr = t - r.C * yr * (r.C * yr), sl = t - r.C * yl * (r.C * yl);
    if (sr < 0.f && sl < 0.f) continue;
    const float margin = 0.02f + 2e-6f * (__builtin_fabsf(slope * yr) + __builtin_fabsf(r.mx));
    const float right = r.mx - slope * yr + __builtin_sqrtf(sr > 0.f ? sr : 0.f) * iA + margin;
    const float left = r.mx - slope * yl - __builtin_sqrtf(sl > 0.f ? sl : 0.f) * iA - margin;
    // Tile x holds the centres 16 x + 0.5 ... 16 x + 15.5.
    int x0 = static_cast<int>(__builtin_ceilf(limit((left - (kTile - 0.5f)) * (1.f / kTile), -1.f, 65536.f)));
    int x1 = static_cast<int>(__builtin_floorf(limit((right - 0.5f) * (1.f / kTile), -1.f, 65536.f))) + 1;
    x0 = x0 > r.x0 ? x0 : r.x0;
    x1 = x1 < r.x1 ? x1 : r.x1;
    for (int x = x0; x < x1; ++x) visit(y * frame.tiles_x + x);
  }
}

// First pass: how many tiles each splat has, how many splats each tile has (per chunk of the sorted order).
inline void count_stage(Pool& pool, Frame& frame, int chunks) {
  const uint32_t* order = frame.order2.as<uint32_t>();
  Record* records = frame.records.as<Record>();
  uint32_t* counts = frame.histogram.as<uint32_t>();
  const int tiles = frame.tiles();
  parallel(pool, chunks, [&](int chunk, int) {
    uint32_t* mine = counts + static_cast<int64_t>(chunk) * tiles;
    std::memset(mine, 0, sizeof(uint32_t) * tiles);
    for (int64_t i = frame.visible * chunk / chunks, end = frame.visible * (chunk + 1) / chunks; i < end; ++i) {
      __builtin_prefetch(&records[order[i + kAhead < end ? i + kAhead : i]], 1);
      Record& r = records[order[i]];
      uint32_t n = 0;
      for_each_tile(frame, r, [&](int tile) { ++mine[tile], ++n; });
      r.count = n;
    }
  });
}

// Prefix sums: slots by Gaussian index, entries by tile and, inside a tile, by chunk.
inline void offset_stage(Frame& frame, int chunks) {
  Record* records = frame.records.as<Record>();
  uint32_t slot = 0;
  for (int64_t n = 0; n < frame.count; ++n) records[n].slot = slot, slot += records[n].count;
  frame.intersections = slot;
  uint32_t *counts = frame.histogram.as<uint32_t>(), *tile_begin = frame.tile_begin.as<uint32_t>();
  uint32_t* word_begin = frame.word_begin.as<uint32_t>();
  uint32_t entry = 0, word = 0;
  for (int tile = 0; tile < frame.tiles(); ++tile) {
    tile_begin[tile] = entry, word_begin[tile] = word;
    for (int chunk = 0; chunk < chunks; ++chunk) {
      uint32_t& c = counts[static_cast<int64_t>(chunk) * frame.tiles() + tile];
      const uint32_t count = c;
      c = entry, entry += count;
    }
    word += (entry - tile_begin[tile] + 63) / 64;
  }
  tile_begin[frame.tiles()] = entry, word_begin[frame.tiles()] = word;
}

inline void fill_stage(Pool& pool, Frame& frame, int chunks) {
  const uint32_t* order = frame.order2.as<uint32_t>();
  const Record* records = frame.records.as<Record>();
  uint32_t* counts = frame.histogram.as<uint32_t>();
  Entry* entries = frame.entries.as<Entry>();
  parallel(pool, chunks, [&](int chunk, int) {
    uint32_t* next = counts + static_cast<int64_t>(chunk) * frame.tiles();
    for (int64_t i = frame.visible * chunk / chunks, end = frame.visible * (chunk + 1) / chunks; i < end; ++i) {
      __builtin_prefetch(&records[order[i + kAhead < end ? i + kAhead : i]]);
      const Record& r = records[order[i]];
      uint32_t slot = r.slot;
      for_each_tile(frame, r, [&](int tile) { entries[next[tile]++] = {order[i], slot++}; });
    }
  });
}

inline void bin_stage(Pool& pool, Frame& frame) {
  const int chunks = frame.visible < 4096 ? 1 : pool.threads();
  const size_t sort_bytes = sizeof(uint32_t) * kRadix * divide_up(frame.visible, kSortChunk);
  const size_t count_bytes = sizeof(uint32_t) * frame.tiles() * static_cast<size_t>(chunks);
  frame.histogram.reserve(sort_bytes > count_bytes ? sort_bytes : count_bytes);
  sort_stage(pool, frame);
  count_stage(pool, frame, chunks);
  offset_stage(frame, chunks);
  frame.entries.reserve(sizeof(Entry) * frame.intersections);
  frame.words.reserve(sizeof(uint64_t) * kBlocks * frame.word_begin.as<uint32_t>()[frame.tiles()]);
  fill_stage(pool, frame, chunks);
}

}  // namespace gsopt::GSOPT_ISA
