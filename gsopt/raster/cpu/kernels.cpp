// Compiled once per instruction set, with GSOPT_ISA naming the namespace: one source, several sets of kernels.
#include <type_traits>

#include "simd.h"
// simd.h first: the shared formulas find their vector functions there.
#include "adam.h"
#include "bin.h"
#include "blend.h"
#include "blend_backward.h"
#include "calibrate.h"
#include "distance.h"
#include "lookup.h"
#include "match.h"
#include "mirror.h"
#include "photometric.h"
#include "project_backward.h"

#define GSOPT_STRING_(x) #x
#define GSOPT_STRING(x) GSOPT_STRING_(x)

namespace gsopt::GSOPT_ISA {

extern const Kernels kernels;
const Kernels kernels = {
    GSOPT_STRING(GSOPT_ISA),
    project_stage,
    bin_stage,
    blend_stage,
    blend_backward_stage,
    project_backward_stage,
    photometric_stage,
    adam_stage,
    match_stage,
    distance_stage,
    lookup_stage,
    mirror_stage,
    calibrate,
};

}  // namespace gsopt::GSOPT_ISA
