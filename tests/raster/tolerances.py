"""Every tolerance of the rasterizer's tests, with its reason."""

from __future__ import annotations

# Two ways of computing the same float64 quantity: some 100 roundings of 1e-16, with room for condition numbers of 1e3.
EXACT = 1e-11

# Central differences in float64 with step 1e-5: the third derivative leaves about 1e-10 of the second power of the
# step times the scale of a pixel squared, cancellation leaves 1e-16 / 1e-5. Relative to the largest gradient entry.
DIFFERENCE_STEP = 1e-5
DIFFERENCE = 2e-7

# A float32 image against the float64 one: a splat's center at pixel 40 is known to 2e-6 px, its exponent (up to 5.5)
# to some 1e-6, and up to 40 layers are added up. One part in 200 000 is far below one step of an 8-bit image (4e-3).
IMAGE = 5e-6

# The unnormalized depth of a float32 image, relative to the largest depth drawn: as IMAGE, one part in 200 000.
DEPTH = 5e-6

# A float32 gradient against the float64 one, |difference| / |gradient| over a whole parameter tensor (L2): sums over
# a thousand pixels of terms with a relative error of some 1e-6 each, which do not all err to the same side.
GRADIENT = 1e-5

# A drawn scene may hold one Gaussian whose gradient nearly cancels and has no relative error to speak of: there, this
# share of the norm of the per-pixel magnitudes of dLoss/dmean2d is permitted on top. Moments about a tile's center
# that are moved to the center of a narrow splat 8 px away lose (8 px / 1 px)² = 64 roundings of 6e-8.
GRADIENT_FLOOR = 5e-6

# The gradient of one needle (projected length : width above 10), relative to that needle's own: inverting its
# covariance loses the square of the ratio where the derivative is written carelessly (1e-3 and worse), and next to
# nothing where the part through the determinant is kept together (docs/math.md, eq. 12).
NEEDLE = 1e-4

# Where the image model decides (threshold at 1/255, stop at T = 1e-4, clamp at 0.99), float32 and float64 may decide
# differently when the deciding quantity is this near the line, relatively. Such pixels are left out of a comparison:
# an exponent of 5.5 off by 1e-6, and needles whose determinant cancels, stay well inside.
DECISION = 1e-4

# The share of pixels that may be left out for that reason; more would mean that the test compares too little.
UNDECIDED_SHARE = 0.05

# Backend.photometric in float32 against float64. The loss is a mean over all pixels and channels: 1e-6. Its gradient,
# relative L2: the variances are differences of squares near 1 (error 1e-7) over C2 = 9e-4, a factor of 1e3 at worst.
LOSS = 2e-6
SSIM_GRADIENT = 2e-4

# One Adam step in float32, relative to the step: a square root, a division and four products.
ADAM = 1e-6

# The stress suite permits more than IMAGE and GRADIENT only for these reasons.
# A needle of 1e6 : 1 whose ends are 6000 px away: its direction, known to 6e-8, decides where it passes each pixel.
SLANT = 2e-4
# Three scales up to 1e18 apart: two axes of 1e6 and 1e3 px may project to nearly one line, and the width of what is
# left is the difference of their products.
SHEARED = 2e-3
# Hundreds of equal layers round to the same side each time: some 1000 roundings of 6e-8 add up.
MANY_LAYERS = 2e-4
# 2e6 m from the origin neighboring float32 numbers are 0.1 to 0.25 m apart; the splats are 100 m wide.
FAR = 3e-3
