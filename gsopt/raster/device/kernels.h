// All kernels of a GPU, one text: NVRTC and HIPRTC compile it when it is first used, tests compile it with g++.
#pragma once
#include "adam.h"
#include "blend.h"
#include "blend_backward.h"
#include "photometric.h"
#include "project.h"
#include "project_backward.h"
