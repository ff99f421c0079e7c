// The Python side of the CPU kernels: arrays in and out by DLPack, no torch, the GIL released while kernels run.
#include <nanobind/stl/array.h>
#include <nanobind/stl/map.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <optional>
#include <string>
#include <tuple>
#include <vector>

#include "workspace.h"
#if defined(GSOPT_HAVE_AVX2)
#include "processor.h"
#endif

namespace gsopt {

#if defined(GSOPT_HAVE_AVX512)
namespace avx512 { extern const Kernels kernels; }
#endif
#if defined(GSOPT_HAVE_AVX2)
namespace avx2 { extern const Kernels kernels; }
namespace avx2x2 { extern const Kernels kernels; }
#endif
namespace portable { extern const Kernels kernels; }

namespace {

// Those this processor can run, best first; asked once: under a hypervisor each question is an exit to it.
const std::vector<const Kernels*>& available_kernels() {
  static const auto kernels = [] {
    std::vector<const Kernels*> found;
#if defined(GSOPT_HAVE_AVX512)
    if (has_avx512()) found.push_back(&avx512::kernels);
#endif
#if defined(GSOPT_HAVE_AVX2)
    if (has_avx2()) {
      found.push_back(&avx2::kernels);
      found.push_back(&avx2x2::kernels);
    }
#endif
    found.push_back(&portable::kernels);
    return found;
  }();
  return kernels;
}

}  // namespace

const Kernels* choose_kernels(const std::string& name) {
  const auto& found = available_kernels();
  if (name.empty()) return found.front();
  std::string names;
  for (const Kernels* k : found) {
    if (name == k->name) return k;
    names += std::string(names.empty() ? "" : ", ") + k->name;
  }
  throw std::invalid_argument("instruction set `" + name + "` is not available here. Choose one of: " + names);
}

namespace {

struct Model {
  Out means, quats, log_scales, logit_opacities, sh0, shN;
  std::array<Out*, 6> all() { return {&means, &quats, &log_scales, &logit_opacities, &sh0, &shN}; }
};

Parameters parameters_of(const Model& m, int sh_degree) {
  const size_t n = m.logit_opacities.size();
  const int rest = n ? static_cast<int>(m.shN.size() / (3 * n)) : 0;
  if (rest > kMaxBands) throw std::invalid_argument("shN holds more than the bands of degree 3");
  if ((sh_degree + 1) * (sh_degree + 1) - 1 > rest && n)
    throw std::invalid_argument("shN holds fewer bands than sh_degree asks for");
  return {static_cast<int64_t>(n), sh_degree, rest, data_of(m.means, 3 * n, "means"), data_of(m.quats, 4 * n, "quats"),
      data_of(m.log_scales, 3 * n, "log_scales"), m.logit_opacities.data(), data_of(m.sh0, 3 * n, "sh0"),
      data_of(m.shN, 3 * n * rest, "shN")};
}

// viewmat [4,4], K [3,3] row-major double: the center is found in double so that far-away scenes keep their precision.
Camera make_camera(const std::vector<double>& V, const std::vector<double>& K, int width, int height, double near_plane,
    double far_plane, double eps2d, bool antialiased) {
  if (V.size() != 16 || K.size() != 9 || width < 1 || height < 1)
    throw std::invalid_argument("camera: wrong number of elements");
  Camera c;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) c.R[3 * i + j] = static_cast<float>(V[4 * i + j]);
  }
  constexpr double kPivotGrid = 32;
  for (int j = 0; j < 3; ++j) {
    double center = 0;
    for (int i = 0; i < 3; ++i) center -= V[4 * i + j] * V[4 * i + 3];
    c.pivot[j] = static_cast<float>(std::round(center / kPivotGrid) * kPivotGrid);
    c.center[j] = static_cast<float>(center - c.pivot[j]);
  }
  for (int i = 0; i < 3; ++i) {
    double t = V[4 * i + 3];
    for (int j = 0; j < 3; ++j) t += V[4 * i + j] * c.pivot[j];
    c.t[i] = static_cast<float>(t);
  }
  const double fx = K[0], fy = K[4], cx = K[2], cy = K[5], margin_x = kViewMargin * 0.5 * width / fx,
               margin_y = kViewMargin * 0.5 * height / fy;
  c.fx = static_cast<float>(fx);
  c.fy = static_cast<float>(fy);
  c.cx = static_cast<float>(cx);
  c.cy = static_cast<float>(cy);
  c.x_min = static_cast<float>(-(cx / fx + margin_x));
  c.x_max = static_cast<float>((width - cx) / fx + margin_x);
  c.y_min = static_cast<float>(-(cy / fy + margin_y));
  c.y_max = static_cast<float>((height - cy) / fy + margin_y);
  c.near_plane = static_cast<float>(near_plane);
  c.far_plane = static_cast<float>(far_plane);
  c.eps2d = static_cast<float>(eps2d);
  c.width = width;
  c.height = height;
  c.antialiased = antialiased;
  return c;
}

void reserve_frame(Frame& f, int64_t n) {
  f.records.reserve(sizeof(Record) * (n + kLargestVector));  // the last vector is written in full
  for (Buffer* b : {&f.keys, &f.order, &f.keys2, &f.order2}) b->reserve(sizeof(uint32_t) * (n + kProjectChunk));
  f.covers.reserve(sizeof(Cover) * (n + 1));
  f.found.reserve(sizeof(Found) * (n / kProjectChunk + 1));
  f.tile_begin.reserve(sizeof(uint32_t) * (f.tiles() + 1));
  for (Buffer* b : {&f.transmittance, &f.last})
    b->reserve(sizeof(float) * kTile * kTile * static_cast<size_t>(f.tiles()));
}

// What `forward` writes, as in raster.RenderedFrame.
struct Image {
  Out colors, alphas;
  std::optional<Out> depths;
  OutInt radii;
};

void forward(Workspace& ws, Frame& frame, const Model& model, const Camera& camera, const Image& image, int sh_degree,
    const std::array<float, 3>& background) {
  std::vector<Work> work(ws.count_work ? ws.pool.threads() : 0);
  const Parameters P = parameters_of(model, sh_degree);
  const size_t pixels = static_cast<size_t>(camera.width) * camera.height;
  const ForwardOutput out = {data_of(image.colors, 3 * pixels, "colors"), data_of(image.alphas, pixels, "alphas"),
      image.depths ? data_of(*image.depths, pixels, "depths") : nullptr,
      data_of(image.radii, 2 * static_cast<size_t>(P.count), "radii"), ws.count_work ? work.data() : nullptr};
  nb::gil_scoped_release release;
  frame.camera = camera;
  std::copy(background.begin(), background.end(), frame.background);
  frame.sh_degree = sh_degree;
  frame.count = P.count;
  frame.skips = ws.skips;
  frame.tiles_x = (camera.width + kTile - 1) / kTile;
  frame.tiles_y = (camera.height + kTile - 1) / kTile;
  if (frame.tiles_x > 65535 || frame.tiles_y > 65535)
    throw std::invalid_argument("the image is wider or higher than 1,048,560 pixels");
  reserve_frame(frame, P.count);
  timed(ws, "project", [&] { ws.kernels->project(ws.pool, frame, P, out.radii); });
  bool fits = true;
  timed(ws, "bin", [&] { fits = ws.kernels->bin(ws.pool, frame, ws.max_entries); });
  if (!fits)
    throw std::overflow_error("the splats cover " + std::to_string(frame.intersections) +
                              " (splat, tile) pairs, more than " + std::to_string(ws.max_entries));
  timed(ws, "blend", [&] { ws.kernels->blend(ws.pool, frame, out); });
  for (const Work& w : work) {
    ws.work.entries += w.entries;
    ws.work.pairs += w.pairs;
  }
}

struct Gradient {
  Out means, quats, log_scales, logit_opacities, sh0;
  std::optional<Out> shN;
  Out means2d;
  std::optional<Out> means2d_abs;
};

void backward(Workspace& ws, Frame& frame, const Model& model, In v_colors, std::optional<In> v_alphas,
    std::optional<In> v_depths, Gradient& g) {
  const Parameters P = parameters_of(model, frame.sh_degree);
  if (P.count != frame.count) throw std::invalid_argument("backward: not the Gaussians that the frame was drawn from");
  const size_t n = static_cast<size_t>(P.count), pixels = static_cast<size_t>(frame.camera.width) * frame.camera.height;
  const BackwardInput in = {data_of(v_colors, 3 * pixels, "v_colors"),
      v_alphas ? data_of(*v_alphas, pixels, "v_alphas") : nullptr,
      v_depths ? data_of(*v_depths, pixels, "v_depths") : nullptr};
  const ParameterGradients out = {data_of(g.means, 3 * n, "v_means"), data_of(g.quats, 4 * n, "v_quats"),
      data_of(g.log_scales, 3 * n, "v_log_scales"), data_of(g.logit_opacities, n, "v_logit_opacities"),
      data_of(g.sh0, 3 * n, "v_sh0"), g.shN ? data_of(*g.shN, 3 * n * P.sh_rest, "v_shN") : nullptr,
      data_of(g.means2d, 2 * n, "v_means2d"),
      g.means2d_abs ? data_of(*g.means2d_abs, 2 * n, "v_means2d_abs") : nullptr};
  nb::gil_scoped_release release;
  frame.rows.reserve(sizeof(float) * kRow * frame.intersections);
  timed(ws, "blend_backward", [&] { ws.kernels->blend_backward(ws.pool, frame, in, out.means2d_abs != nullptr); });
  timed(ws, "project_backward", [&] { ws.kernels->project_backward(ws.pool, frame, P, out); });
}

std::tuple<double, double> photometric(
    Workspace& ws, In rendered, In target, Out v_rendered, int height, int width, float lambda_dssim) {
  const size_t size = 3 * static_cast<size_t>(height) * width;
  PhotometricArguments a = {data_of(rendered, size, "rendered"), data_of(target, size, "target"),
      data_of(v_rendered, size, "v_rendered"), height, width, lambda_dssim, &ws.scratch, 0, 0};
  nb::gil_scoped_release release;
  timed(ws, "photometric", [&] { ws.kernels->photometric(ws.pool, a); });
  return {a.l1, a.ssim};
}

// Rates and numbers of steps, from 1, of the six tensors of a model, as in raster.AdamStep; 0 steps: left alone.
struct AdamStep {
  std::array<double, 6> lr;
  std::array<int64_t, 6> steps;
  double beta1, beta2, eps;
};

void adam(Workspace& ws, Model& model, Gradient& g, Model& exp_avg, Model& exp_avg_sq, const AdamStep& step,
    const Camera& camera, int sh_degree) {
  const Parameters P = parameters_of(model, sh_degree);
  if (P.count == 0) return;
  AdamArguments a = {P.count, static_cast<float>(step.beta1), static_cast<float>(step.beta2),
      static_cast<float>(step.eps), {}, {}, P.means, data_of(g.sh0, 3 * static_cast<size_t>(P.count), "v_sh0"), camera,
      sh_degree};
  const std::array<Out*, 6> gradients = {
      &g.means, &g.quats, &g.log_scales, &g.logit_opacities, &g.sh0, g.shN ? &*g.shN : nullptr};
  for (int k = 0; k < 6; ++k) {
    Out &param = *model.all()[k], &m = *exp_avg.all()[k], &v = *exp_avg_sq.all()[k];
    const size_t size = param.size();
    if (step.steps[k] == 0 || size == 0) continue;
    const double t = static_cast<double>(step.steps[k]);
    const double correction1 = 1.0 - std::pow(step.beta1, t), correction2 = 1.0 - std::pow(step.beta2, t);
    AdamParameter& out = gradients[k] ? a.others[k] : a.bands;
    out = {param.data(), data_of(m, size, "exp_avg"), data_of(v, size, "exp_avg_sq"),
        gradients[k] ? data_of(*gradients[k], size, "grad") : nullptr, static_cast<int64_t>(size) / P.count,
        static_cast<float>(step.lr[k] / correction1), static_cast<float>(1.0 / std::sqrt(correction2))};
  }
  nb::gil_scoped_release release;
  timed(ws, "adam", [&] { ws.kernels->adam(ws.pool, a); });
}

}  // namespace

NB_MODULE(_cpu, m) {
  m.doc() = "CPU kernels of gsopt.raster; used through gsopt.raster.cpu_backend.";
  m.def("instruction_sets", [] {
    std::vector<std::string> names;
    for (const Kernels* k : available_kernels()) names.emplace_back(k->name);
    return names;
  });
  nb::class_<Workspace>(m, "Workspace")
      .def(nb::init<int, const std::string&>(), nb::arg("threads"), nb::arg("isa"))
      .def_prop_ro("isa", [](const Workspace& w) { return std::string(w.kernels->name); })
      .def_ro("seconds", &Workspace::seconds)
      .def_ro("cpu_seconds", &Workspace::cpu_seconds)
      .def("calibrate",
          [](const Workspace& w) {
            const Calibration c = w.kernels->calibrate();
            return std::tuple(c.fma, c.exp);
          })
      .def_rw("count_work", &Workspace::count_work)
      .def_rw("max_entries", &Workspace::max_entries)
      .def_prop_rw(
          "skip_tiles", [](const Workspace& w) { return w.skips.tiles; },
          [](Workspace& w, bool on) { w.skips.tiles = on; })
      .def_prop_rw(
          "skip_terminated", [](const Workspace& w) { return w.skips.termination; },
          [](Workspace& w, bool on) { w.skips.termination = on; })
      .def_prop_ro("work", [](const Workspace& w) { return std::tuple(w.work.entries, w.work.pairs); })
      .def_prop_ro("threads", [](const Workspace& w) { return w.pool.threads(); });
  nb::class_<Frame>(m, "Frame")
      .def(nb::init<>())
      .def_ro("visible", &Frame::visible)
      .def_ro("intersections", &Frame::intersections);
  nb::class_<Camera>(m, "Camera")
      .def("__init__", [](Camera* self, const std::vector<double>& V, const std::vector<double>& K, int width,
                           int height, double near_plane, double far_plane, double eps2d, bool antialiased) {
        new (self) Camera(make_camera(V, K, width, height, near_plane, far_plane, eps2d, antialiased));
      });
  // noconvert: what is to be written must not be a copy.
  const auto out = nb::arg().noconvert();
  const auto out_or_none = nb::arg().noconvert().none();
  const auto in_or_none = nb::arg().none();
  nb::class_<Model>(m, "Model").def(nb::init<Out, Out, Out, Out, Out, Out>(), out, out, out, out, out, out);
  using MaybeOut = std::optional<Out>;
  nb::class_<Gradient>(m, "Gradient")
      .def(nb::init<Out, Out, Out, Out, Out, MaybeOut, Out, MaybeOut>(), out, out, out, out, out, out_or_none, out,
          out_or_none);
  nb::class_<Image>(m, "Image").def(nb::init<Out, Out, MaybeOut, OutInt>(), out, out, out_or_none, out);
  nb::class_<AdamStep>(m, "AdamStep")
      .def(nb::init<std::array<double, 6>, std::array<int64_t, 6>, double, double, double>(), nb::kw_only(),
          nb::arg("lr"), nb::arg("steps"), nb::arg("beta1"), nb::arg("beta2"), nb::arg("eps"));
  m.def("forward", &forward, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::kw_only(), nb::arg("sh_degree"),
      nb::arg("background"));
  m.def("backward", &backward, nb::arg(), nb::arg(), nb::arg(), nb::arg(), in_or_none, in_or_none, nb::arg());
  m.def("photometric", &photometric);
  m.def("adam", &adam, nb::arg(), nb::arg(), nb::arg(), nb::kw_only(), nb::arg("exp_avg"), nb::arg("exp_avg_sq"),
      nb::arg("step"), nb::arg("camera"), nb::arg("sh_degree"));
  define_preparation(m);
}

}  // namespace gsopt
