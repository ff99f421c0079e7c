// Real spherical harmonics up to degree 3 (docs/math.md, 17) and their derivatives, F = float or a vector of floats.
// Signs and order as in Kerbl et al. 2023: Condon-Shortley phase kept; band l holds m = -l..l.
#pragma once
#include "projection.h"

namespace gsopt::GSOPT_ISA {

constexpr float kSH0 = 0.28209479177387814f;

// Y_1..Y_{K-1} at the unit vector (x, y, z), K = (degree+1)^2. Y_0 is the constant kSH0.
template <class F> inline void sh_basis(int degree, F x, F y, F z, F* Y) {
  if (degree < 1) return;
  Y[0] = y * -0.48860251190291992f;
  Y[1] = z * 0.48860251190291992f;
  Y[2] = x * -0.48860251190291992f;
  if (degree < 2) return;
  const F xx = x * x, yy = y * y, zz = z * z, xy = x * y;
  Y[3] = xy * 1.0925484305920792f;
  Y[4] = y * z * -1.0925484305920792f;
  Y[5] = (zz * 2.f - xx - yy) * 0.31539156525252005f;
  Y[6] = x * z * -1.0925484305920792f;
  Y[7] = (xx - yy) * 0.54627421529603959f;
  if (degree < 3) return;
  const F band = zz * 4.f - xx - yy;
  Y[8] = y * (xx * 3.f - yy) * -0.59004358992664352f;
  Y[9] = xy * z * 2.8906114426405538f;
  Y[10] = y * band * -0.45704579946446572f;
  Y[11] = z * (zz * 2.f - xx * 3.f - yy * 3.f) * 0.37317633259011546f;
  Y[12] = x * band * -0.45704579946446572f;
  Y[13] = z * (xx - yy) * 1.4453057213202769f;
  Y[14] = x * (xx - yy * 3.f) * -0.59004358992664352f;
}

// The unit vector from the camera to a mean at `offset` from the pivot.
template <class F> inline Vec3<F> view_directions(const Camera& cam, const Vec3<F>& offset, F& inverse_distance) {
  const Vec3<F> d = offset - splat3<F>(cam.center);
  inverse_distance = splat<F>(1.f) / sqrt(max(dot(d, d), splat<F>(1e-30f)));
  return d * inverse_distance;
}

// Their partial derivatives, of the same polynomials (x, y, z taken as independent): the gradients of (18).
template <class F> inline void sh_basis_gradient(int degree, F x, F y, F z, Vec3<F>* out) {
  const F zero = x * 0.f;
  if (degree < 1) return;
  out[0] = {zero, zero - 0.48860251190291992f, zero};
  out[1] = {zero, zero, zero + 0.48860251190291992f};
  out[2] = {zero - 0.48860251190291992f, zero, zero};
  if (degree < 2) return;
  constexpr float a = 1.0925484305920792f, b = 0.31539156525252005f;
  out[3] = {y * a, x * a, zero};
  out[4] = {zero, z * -a, y * -a};
  out[5] = {x * (-2.f * b), y * (-2.f * b), z * (4.f * b)};
  out[6] = {z * -a, zero, x * -a};
  out[7] = {x * a, y * -a, zero};
  if (degree < 3) return;
  const F xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
  constexpr float c = 0.59004358992664352f, d = 2.8906114426405538f, e = 0.45704579946446572f;
  constexpr float f = 0.37317633259011546f, g = 1.4453057213202769f;
  out[8] = {xy * (-6.f * c), (xx - yy) * (-3.f * c), zero};
  out[9] = {yz * d, xz * d, xy * d};
  out[10] = {xy * (2.f * e), (zz * 4.f - xx - yy * 3.f) * -e, yz * (-8.f * e)};
  out[11] = {xz * (-6.f * f), yz * (-6.f * f), (zz * 2.f - xx - yy) * (3.f * f)};
  out[12] = {(zz * 4.f - xx * 3.f - yy) * -e, xy * (2.f * e), xz * (-8.f * e)};
  out[13] = {xz * (2.f * g), yz * (-2.f * g), (xx - yy) * g};
  out[14] = {(xx - yy) * (-3.f * c), xy * (6.f * c), zero};
}

}  // namespace gsopt::GSOPT_ISA
