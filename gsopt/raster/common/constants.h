// The numbers that define the image (docs/math.md), shared by every kernel.
#pragma once

namespace gsopt {

constexpr int kTile = 16;  // pixels along a tile's side
constexpr float kAlphaMin = 1.f / 255.f;
constexpr float kAlphaMax = 0.99f;
constexpr float kTransmittanceMin = 1e-4f;
constexpr float kLog2AlphaMin = -7.994353436858858f;  // log2(1/255)
constexpr float kHalfLog2E = 0.7213475204444817f;     // log2(e) / 2: exp(-q/2) = 2^(-kHalfLog2E q)
constexpr float kSqrtHalfLog2E = 0.8493218002880191f;
constexpr float kDetMin = 1e-12f;    // px^4: splats of less area are not drawn (only with eps2d near 0)
constexpr float kViewMargin = 0.3f;  // the Jacobian is clamped this share of tan(fov/2) outside the view

}  // namespace gsopt
