// Real spherical harmonics up to degree 3 and their derivatives, F = float or a vector of floats.
// Signs and order as in Kerbl et al. 2023 (Condon-Shortley phase kept; band l holds m = -l..l); docs/math.md, section
// SH.
#pragma once

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

// The partial derivatives of the same polynomials (x, y, z taken as independent).
template <class F> inline void sh_basis_gradient(int degree, F x, F y, F z, F* Yx, F* Yy, F* Yz) {
  const F zero = x * 0.f;
  if (degree < 1) return;
  for (int k = 0; k < (degree + 1) * (degree + 1) - 1; ++k) Yx[k] = Yy[k] = Yz[k] = zero;
  Yy[0] = Yx[2] = zero - 0.48860251190291992f;
  Yz[1] = zero + 0.48860251190291992f;
  if (degree < 2) return;
  constexpr float a = 1.0925484305920792f, b = 0.31539156525252005f;
  Yx[3] = y * a;
  Yy[3] = x * a;
  Yy[4] = z * -a;
  Yz[4] = y * -a;
  Yx[5] = x * (-2.f * b);
  Yy[5] = y * (-2.f * b);
  Yz[5] = z * (4.f * b);
  Yx[6] = z * -a;
  Yz[6] = x * -a;
  Yx[7] = x * a;
  Yy[7] = y * -a;
  if (degree < 3) return;
  const F xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
  constexpr float c = 0.59004358992664352f, d = 2.8906114426405538f, e = 0.45704579946446572f, f = 0.37317633259011546f,
                  g = 1.4453057213202769f;
  Yx[8] = xy * (-6.f * c);
  Yy[8] = (xx - yy) * (-3.f * c);
  Yx[9] = yz * d;
  Yy[9] = xz * d;
  Yz[9] = xy * d;
  Yx[10] = xy * (2.f * e);
  Yy[10] = (zz * 4.f - xx - yy * 3.f) * -e;
  Yz[10] = yz * (-8.f * e);
  Yx[11] = xz * (-6.f * f);
  Yy[11] = yz * (-6.f * f);
  Yz[11] = (zz * 2.f - xx - yy) * (3.f * f);
  Yx[12] = (zz * 4.f - xx * 3.f - yy) * -e;
  Yy[12] = xy * (2.f * e);
  Yz[12] = xz * (-8.f * e);
  Yx[13] = xz * (2.f * g);
  Yy[13] = yz * (-2.f * g);
  Yz[13] = (xx - yy) * g;
  Yx[14] = (xx - yy) * (-3.f * c);
  Yy[14] = xy * (6.f * c);
}

}  // namespace gsopt::GSOPT_ISA
