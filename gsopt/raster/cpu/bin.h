// Stage 2: visible splats sorted front to back (stable radix sort on depth), then listed per tile in that order.
#pragma once
#include "frame.h"
#include "parallel.h"
#include "tiles.h"

namespace gsopt::GSOPT_ISA {

constexpr int kRadixBits = 11, kRadix = 1 << kRadixBits;
constexpr int kAhead = 48;  // splats are visited in depth order, that is anywhere in memory: ask for them early

// How many numbers a thread sorts at once: each its share, of few or of very many some more chunks.
inline int64_t sort_chunk(const Pool& pool, int64_t n) {
  const int64_t fair = divide_up(n, pool.threads());
  return fair < 4096 ? 4096 : (fair > 32768 ? 32768 : fair);
}

// Least significant digit first, 3 passes of 11 bits; chunks of the input keep their order, so ties go by index.
inline void sort_stage(Pool& pool, Frame& frame) {
  const int64_t n = frame.visible, size = sort_chunk(pool, n);
  const int chunks = divide_up(n, size);
  Buffer *keys[2] = {&frame.keys, &frame.keys2}, *ids[2] = {&frame.order, &frame.order2};
  uint32_t* histogram = frame.histogram.as<uint32_t>();
  for (int pass = 0; pass < 3; ++pass) {
    const int shift = pass * kRadixBits, from = pass & 1;
    const uint32_t *key = keys[from]->as<uint32_t>(), *id = ids[from]->as<uint32_t>();
    uint32_t *key_out = keys[1 - from]->as<uint32_t>(), *id_out = ids[1 - from]->as<uint32_t>();
    const auto range = [&](int chunk, int64_t& begin, int64_t& end) {
      begin = chunk * size;
      end = begin + size < n ? begin + size : n;
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
        h = sum;
        sum += count;
      }
    }
    parallel(pool, chunks, [&](int chunk, int) {
      uint32_t* h = histogram + static_cast<int64_t>(chunk) * kRadix;
      int64_t begin, end;
      range(chunk, begin, end);
      for (int64_t i = begin; i < end; ++i) {
        const uint32_t to = h[key[i] >> shift & (kRadix - 1)]++;
        key_out[to] = key[i];
        id_out[to] = id[i];
      }
    });
  }
}  // an odd number of passes: the sorted ids are in order2

// Calls visit(id, cover) for the splats of a part of the sorted order; while it does, the next ones are asked for.
template <class Visit> inline void for_each_cover(const Frame& frame, int chunk, int chunks, Visit&& visit) {
  const uint32_t* order = frame.order2.as<uint32_t>();
  const Cover* covers = frame.covers.as<Cover>();
  for (int64_t i = frame.visible * chunk / chunks, end = frame.visible * (chunk + 1) / chunks; i < end; ++i) {
    __builtin_prefetch(&covers[order[i + kAhead < end ? i + kAhead : i]]);
    visit(order[i], covers[order[i]]);
  }
}

// First pass: how many splats each tile has, per chunk of the sorted order.
inline void count_stage(Pool& pool, Frame& frame, int chunks) {
  uint32_t* counts = frame.histogram.as<uint32_t>();
  const int tiles = frame.tiles();
  parallel(pool, chunks, [&](int chunk, int) {
    uint32_t* mine = counts + static_cast<int64_t>(chunk) * tiles;
    std::memset(mine, 0, sizeof(uint32_t) * tiles);
    for_each_cover(frame, chunk, chunks,
        [&](uint32_t id, const Cover& cover) { for_each_tile(frame, cover, id, [&](int tile) { ++mine[tile]; }); });
  });
}

// Prefix sums: entries by tile and, inside a tile, by chunk.
inline void offset_stage(Frame& frame, int chunks) {
  uint32_t *counts = frame.histogram.as<uint32_t>(), *tile_begin = frame.tile_begin.as<uint32_t>();
  uint32_t entry = 0;
  for (int tile = 0; tile < frame.tiles(); ++tile) {
    tile_begin[tile] = entry;
    for (int chunk = 0; chunk < chunks; ++chunk) {
      uint32_t& c = counts[static_cast<int64_t>(chunk) * frame.tiles() + tile];
      const uint32_t count = c;
      c = entry;
      entry += count;
    }
  }
  tile_begin[frame.tiles()] = entry;
}

inline void fill_stage(Pool& pool, Frame& frame, int chunks) {
  uint32_t* counts = frame.histogram.as<uint32_t>();
  Entry* entries = frame.entries.as<Entry>();
  parallel(pool, chunks, [&](int chunk, int) {
    uint32_t* next = counts + static_cast<int64_t>(chunk) * frame.tiles();
    for_each_cover(frame, chunk, chunks, [&](uint32_t id, const Cover& cover) {
      uint32_t slot = cover.slot;
      for_each_tile(frame, cover, id, [&](int tile) { entries[next[tile]++] = {id, slot++}; });
    });
  });
}

// False, and no entries, when there would be more than `max_entries`.
inline bool bin_stage(Pool& pool, Frame& frame, int64_t max_entries) {
  if (frame.intersections > max_entries) return false;
  const int chunks = frame.visible < 4096 ? 1 : pool.threads();
  const size_t sort_bytes = sizeof(uint32_t) * kRadix * divide_up(frame.visible, sort_chunk(pool, frame.visible));
  const size_t count_bytes = sizeof(uint32_t) * frame.tiles() * static_cast<size_t>(chunks);
  frame.histogram.reserve(sort_bytes > count_bytes ? sort_bytes : count_bytes);
  sort_stage(pool, frame);
  count_stage(pool, frame, chunks);
  offset_stage(frame, chunks);
  frame.entries.reserve(sizeof(Entry) * frame.intersections);
  frame.masks.reserve(sizeof(uint32_t) * frame.intersections);
  fill_stage(pool, frame, chunks);
  return true;
}

}  // namespace gsopt::GSOPT_ISA
