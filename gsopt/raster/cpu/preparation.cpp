// The Python side of the kernels that prepare what is optimized: stereo matching, distances, lookups, mirror planes.
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <optional>
#include <tuple>
#include <vector>

#include "workspace.h"

namespace gsopt {

namespace {

// What stays the same while planes are tried for the pixels of one picture.
struct Windows {
  In offsets, rays, windows, inverse_deviation;
  float step_x, step_y, least_variance, unseen;
};

// A: 9 and T: 3 floats; costs and each third of `planes` have one element per ray.
void match(Workspace& ws, const Windows& w, In corners, int height, int width, const std::vector<float>& A,
    const std::vector<float>& T, In planes, Out costs) {
  const size_t padded = costs.size(), taps = w.offsets.size() / 2;
  if (A.size() != 9 || T.size() != 3 || padded % 8 || width < 2 || height < 2)
    throw std::invalid_argument("match: wrong number of elements");
  MatchArguments a = {static_cast<int64_t>(padded), static_cast<int>(taps), w.offsets.data(),
      data_of(w.rays, 2 * padded, "rays"), data_of(w.windows, 2 * taps * padded, "windows"),
      data_of(w.inverse_deviation, padded, "inverse_deviation"), data_of(planes, 3 * padded, "planes"),
      data_of(corners, 4 * static_cast<size_t>(height) * width, "corners"), width, height, {}, {}, w.step_x, w.step_y,
      w.least_variance, w.unseen, costs.data()};
  std::copy(A.begin(), A.end(), a.A);
  std::copy(T.begin(), T.end(), a.T);
  nb::gil_scoped_release release;
  timed(ws, "match", [&] { ws.kernels->match(ws.pool, a); });
}

void squared_distance(Workspace& ws, InByte cells, int reach, OutShort squared) {
  DistanceArguments a = {cells.data(), {}, reach, data_of(squared, cells.size(), "squared"), &ws.scratch};
  for (int axis = 0; axis < 3; ++axis) a.shape[axis] = static_cast<int>(cells.shape(axis));
  if (reach < 0 || reach * reach > kFarSquared) throw std::invalid_argument("squared_distance: reach out of range");
  nb::gil_scoped_release release;
  timed(ws, "distance", [&] { ws.kernels->distance(a); });
}

// R: 9 and t: 3 floats; K: fx, fy, cx, cy, columns, rows; then the image, and the value of what it does not show.
using PictureParts = std::tuple<std::array<float, 9>, std::array<float, 3>, std::array<float, 6>, InImage, float>;

Picture picture_of(const PictureParts& parts) {
  const auto& [R, t, K, image, unseen] = parts;
  if (image.size() == 0) throw std::invalid_argument("lookup: an empty image");
  Picture p = {{}, {}, K[0], K[1], K[2], K[3], K[4], K[5], image.data(), static_cast<int>(image.shape(1)),
      static_cast<int>(image.shape(0)), unseen};
  std::copy(R.begin(), R.end(), p.R);
  std::copy(t.begin(), t.end(), p.t);
  return p;
}

void lookup(Workspace& ws, In points, const std::vector<PictureParts>& parts, std::optional<float> beside, float radius,
    float enough, Out values, OutInt shown) {
  const size_t count = values.size();
  std::vector<Picture> pictures;
  for (const PictureParts& each : parts) pictures.push_back(picture_of(each));
  if (pictures.empty()) throw std::invalid_argument("lookup: no picture");
  const LookupArguments a = {static_cast<int64_t>(count), data_of(points, 3 * count, "points"), pictures.data(),
      static_cast<int>(pictures.size()), !beside, radius, beside.value_or(0), enough, values.data(),
      data_of(shown, count, "shown")};
  nb::gil_scoped_release release;
  timed(ws, "lookup", [&] { ws.kernels->lookup(ws.pool, a); });
}

// Voxels that a photo shows, the pixel of each, and the number of pixels.
using Shown = std::tuple<InInt, InInt, int64_t>;

void mirror(
    Workspace& ws, In centers, In normals, In offsets, InByte cells, const std::vector<Shown>& shown, Out lost) {
  const size_t planes = lost.size(), count = centers.size() / 3;
  std::vector<MirrorPhoto> photos;
  for (const auto& [rows, pixel, pixels] : shown) {
    const MirrorPhoto photo = {
        static_cast<int64_t>(rows.size()), pixels, rows.data(), data_of(pixel, rows.size(), "pixel")};
    const auto within = [](const int32_t* values, int64_t n, int64_t limit) {
      return std::all_of(values, values + n, [&](int32_t value) { return value >= 0 && value < limit; });
    };
    if (!within(photo.rows, photo.count, static_cast<int64_t>(count)) || !within(photo.pixel, photo.count, pixels))
      throw std::invalid_argument("mirror: a photo shows what is not there");
    photos.push_back(photo);
  }
  MirrorArguments a = {static_cast<int64_t>(count), static_cast<int64_t>(planes),
      data_of(centers, 3 * count, "centers"), data_of(normals, 3 * planes, "normals"),
      data_of(offsets, planes, "offsets"), cells.data(), {}, photos.data(), static_cast<int>(photos.size()),
      lost.data(), &ws.scratch};
  for (int axis = 0; axis < 3; ++axis) a.shape[axis] = static_cast<int>(cells.shape(axis));
  nb::gil_scoped_release release;
  timed(ws, "mirror", [&] { ws.kernels->mirror(ws.pool, a); });
}

}  // namespace

void define_preparation(nb::module_& m) {
  const auto out = nb::arg().noconvert();  // what is to be written must not be a copy
  nb::class_<Windows>(m, "Windows").def(nb::init<In, In, In, In, float, float, float, float>());
  m.def("match", &match);
  m.def("squared_distance", &squared_distance, nb::arg(), nb::arg(), nb::arg(), out);
  m.def("lookup", &lookup, nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), out, out);
  m.def("mirror", &mirror, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), out);
}

}  // namespace gsopt
