// What one camera's forward pass leaves for its backward pass, and the table of kernels of one instruction set.
// Plain data and pointers: the files compiled for one instruction set include this and nothing that allocates.
#pragma once
#include <cstddef>
#include <cstdint>

#include "../common/adam.h"
#include "../common/projection.h"
#include "pool.h"

namespace gsopt {

constexpr int kChunk = 256;  // splats of a tile that are worked on at once
constexpr int kProjectChunk = 1024;
constexpr int kLargestVector = 16;  // lanes, of any instruction set

// Grows, never shrinks, 64-byte aligned; contents are lost when it grows.
class Buffer {
 public:
  Buffer() = default;
  ~Buffer();
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  void reserve(size_t bytes);
  template <class T> T* as() const { return static_cast<T*>(data_); }
  size_t bytes() const { return capacity_; }

 private:
  void* data_ = nullptr;
  size_t capacity_ = 0;
};

void keep_freed_memory();

// A splat on the image plane: (8a) has its exponent in base 2, log2_opacity - (A dx + B dy)² - (C dy)².
struct alignas(64) Record {
  float mx, my, A, B, C, log2_opacity, r, g;
  float b, depth;
  uint16_t x0, x1, y0, y1;  // tiles, half open
};
static_assert(sizeof(Record) == 64);

// The tiles of a splat, in little memory: they are asked for in an order that no cache foresees.
struct Cover {
  uint64_t tiles;   // which of a small box it touches (cpu/tiles.h)
  uint16_t x0, y0;  // where that box begins, or kAskRecord twice
  uint32_t slot;    // its intersections are the rows [slot, slot of the next) of the gradient buffer
};
static_assert(sizeof(Cover) == 16);
constexpr uint16_t kAskRecord = 0xffff;

// What kProjectChunk Gaussians brought: visible splats, intersections.
struct Found {
  uint32_t visible;
  int64_t intersections;
};

// One splat in one tile.
struct Entry {
  uint32_t id, slot;
};

constexpr int kRow = 16;  // floats of a row of gradient sums: those of RowField, and zeros

struct Parameters {
  int64_t count;
  int sh_degree, sh_rest;  // highest band to evaluate; number of rows of shN
  const float *means, *quats, *log_scales, *logit_opacities, *sh0, *shN;
};

struct ParameterGradients {
  float *means, *quats, *log_scales, *logit_opacities, *sh0, *shN, *means2d,
      *means2d_abs;  // shN and the last may be null
};

// What a frame does not compute because no pixel would change; each can be switched off, to see what it is worth.
struct Skips {
  bool tiles = true;  // a splat is listed only in the tiles, and drawn only in the blocks, that its ellipse reaches
  bool termination = true;  // a block takes no more splats soon after all its pixels are opaque
};

struct Frame {
  Camera camera;
  float background[3];
  int sh_degree = 0, tiles_x = 0, tiles_y = 0;
  int64_t count = 0, visible = 0, intersections = 0;
  bool depth = false;
  Skips skips;
  Buffer records;        // Record[count]
  Buffer covers;         // Cover[count + 1]
  Buffer keys, order;    // uint32[count]: depth bits, ids, sorted front to back
  Buffer keys2, order2;  // scratch of the sort
  Buffer histogram;      // scratch of sort and binning
  Buffer found;          // Found[chunks]: scratch of projection
  Buffer tile_begin;     // uint32[tiles + 1]: first entry of a tile
  Buffer entries;        // Entry[intersections]
  Buffer masks;          // uint32[intersections]: bit b: the splat reaches block b of the tile, not yet opaque
  Buffer transmittance;  // float[tiles][blocks][pixels]
  Buffer last;  // int32[tiles][blocks][pixels]: number in the tile, from 1, of the last splat that counts; 0: none
  Buffer rows;  // float[intersections][kRow]
  int tiles() const { return tiles_x * tiles_y; }
};

// What a frame cost: (splat, block) pairs looked at, and (splat, pixel) pairs that contributed.
struct alignas(64) Work {
  int64_t entries = 0, pairs = 0;
};

struct ForwardOutput {
  float *colors, *alphas, *depths;  // [H,W,3], [H,W], [H,W] or null
  int32_t* radii;                   // [N,2]
  Work* work;                       // one per thread, or null: do not count
};

struct BackwardInput {
  const float *v_colors, *v_alphas, *v_depths;  // last two may be null
};

struct PhotometricArguments {
  const float *rendered, *target;  // [H,W,3]
  float* v_rendered;
  int height, width;
  float lambda_dssim;
  Buffer* scratch;
  double l1, ssim;  // out: means
};

constexpr int kMaxBands = 15;  // rows of shN

// One tensor of the Gaussians, `stride` numbers each; param is null where it is left alone.
struct AdamParameter {
  float *param = nullptr, *exp_avg = nullptr, *exp_avg_sq = nullptr;
  const float* grad = nullptr;
  int64_t stride = 0;
  float step_size = 0, inv_sqrt_correction2 = 0;
};

struct AdamArguments {
  int64_t count;
  AdamRates rates;
  AdamParameter bands;  // shN without a gradient, which is found from the rest
  AdamParameter others[6];
  const float *means, *v_sh0;
  Camera camera;
  int sh_degree;
};

// One picture's windows against one other picture (cpu/match.h); pixels padded to a multiple of eight.
struct MatchArguments {
  int64_t padded;
  int taps;
  const float* offsets;            // [taps, 2], px
  const float* rays;               // [2, padded]: x and y of (x, y, 1)
  const float* windows;            // [padded / 8, taps, 2, 8]: a tap's weight, and that times the value less the mean
  const float* inverse_deviation;  // [padded]
  const float* planes;             // [3, padded]: inverse depth a x + b y + c
  const float* corners;            // [height, width, 4]: value at a pixel, right of it, below it, and both
  int width, height;
  float A[9], T[3];      // source pixels, times depth, from the ray and the inverse depth
  float step_x, step_y;  // of a pixel in the ray
  float least_variance, unseen;
  float* costs;  // [padded]
};

// Squared distances in a grid, the last axis contiguous (cpu/distance.h).
constexpr int16_t kFarSquared = 1 << 13;  // beyond everything; with the square of a reach it still fits 16 bits
struct DistanceArguments {
  const uint8_t* cells;
  int shape[3];
  int reach;  // cells, its square no more than kFarSquared
  int16_t* squared;
  Buffer* slab;
};

// The lowest value that several pictures have at points (cpu/lookup.h).
struct Picture {
  float R[9], t[3];  // cam_from_world
  float fx, fy, cx, cy, columns, rows;
  const float* image;  // [height, width]: the camera's columns and rows at any resolution
  int width, height;
  float unseen;  // value of a point that is not shown
};
struct LookupArguments {
  int64_t count;
  const float* points;  // [count, 3]
  const Picture* pictures;
  int picture_count;
  bool beside_is_border;  // points before the camera and beside the image have the border's value
  float radius, beside;   // else, within this distance (scene units) of what the camera sees, they have this one
  float enough;           // no more pictures are looked at for points with a value as low
  float* values;          // [count]
  int32_t* shown;         // [count]: by how many of the pictures that were looked at
};

// Mirror planes of a grid, in units of its voxels (cpu/mirror.h).
struct MirrorPhoto {
  int64_t count, pixels;
  const int32_t *rows, *pixel;  // [count]: voxels that it shows, and where
};
struct MirrorArguments {
  int64_t count, planes;
  const float *centers, *normals, *offsets;  // [count, 3], [planes, 3] and [planes]
  const uint8_t* cells;                      // of `shape`: where a mirror image may lie
  int shape[3];
  const MirrorPhoto* photos;
  int photo_count;
  float* lost;  // [planes]
  Buffer* words;
};

// What one core can do at best, lanes per second: fused multiply-adds, and exponentials.
struct Calibration {
  double fma, exp;
};

// The kernels of one instruction set.
struct Kernels {
  const char* name;
  void (*project)(Pool&, Frame&, const Parameters&, int32_t* radii);
  bool (*bin)(Pool&, Frame&, int64_t max_entries);
  void (*blend)(Pool&, Frame&, const ForwardOutput&);
  void (*blend_backward)(Pool&, Frame&, const BackwardInput&, bool absgrad);
  void (*project_backward)(Pool&, Frame&, const Parameters&, const ParameterGradients&);
  void (*photometric)(Pool&, PhotometricArguments&);
  void (*adam)(Pool&, const AdamArguments&);
  void (*match)(Pool&, const MatchArguments&);
  void (*distance)(const DistanceArguments&);
  void (*lookup)(Pool&, const LookupArguments&);
  void (*mirror)(Pool&, const MirrorArguments&);
  Calibration (*calibrate)();
};

}  // namespace gsopt
