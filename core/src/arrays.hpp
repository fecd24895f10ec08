// Numbers of Python in, and numbers of the core out as arrays that Python owns.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <stdexcept>

#include "handmap/busy.hpp"
#include "handmap/step.hpp"

namespace nb = nanobind;

namespace handmap {

using Array = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;

template <class Model>
Model model_of(const nb::bytes& bytes) {
  return decode<Model>({bytes.c_str(), bytes.size()});
}

template <class Model>
std::optional<Model> optional_model(const std::optional<nb::bytes>& bytes) {
  return bytes ? std::optional<Model>(model_of<Model>(*bytes)) : std::nullopt;
}

inline Vector vector_of(const Array& a) { return Vector(a.data(), a.data() + a.size()); }

inline void expect_size(const Array& a, size_t size, const char* name) {
  if (a.size() != size) throw std::invalid_argument(std::string("wrong size of ") + name);
}

// Reject what other sizes or indices would lead out of: Python may build an object of parts of others.
inline void expect(bool is_right, const char* problem) {
  if (!is_right) throw std::invalid_argument(problem);
}
inline std::vector<Vec3> points_of(const Array& a) {
  std::vector<Vec3> points(a.size() / 3);
  for (size_t k = 0; k < points.size(); ++k)
    points[k] = {a.data()[3 * k], a.data()[3 * k + 1], a.data()[3 * k + 2]};
  return points;
}

inline std::vector<Attached> attached_of(const Indices& joints, const Array& offsets) {
  expect_size(offsets, 3 * joints.size(), "offsets");
  const std::vector<Vec3> at = points_of(offsets);
  std::vector<Attached> points(joints.size());
  // Pinocchio counts the world as joint 0.
  for (size_t k = 0; k < points.size(); ++k) points[k] = {joints[k] - 1, at[k]};
  return points;
}

// The element of a sequence of Python.
inline nb::object item(const nb::object& sequence, size_t i) { return sequence[nb::int_(i)]; }

inline void expect_joints(const Tree& tree, const std::vector<Attached>& points) {
  for (const Attached& point : points)
    expect(tree.has_joint(point.joint), "points of another hand");
}

using NumpyArray = nb::object;

// A name of Python, which is made once for each place that asks for it.
inline const nb::object& interned(const char* name) {
  return *new nb::object(nb::steal(PyUnicode_InternFromString(name)));
}

inline const nb::object& numpy_attribute(const char* name) {
  return *new nb::object(nb::module_::import_("numpy").attr(name));
}

// Numbers of an array of Python, borrowed row by row. An import by nanobind takes six times longer.
class Borrowed {
 public:
  // Of a shape; nothing of what is not a numpy array of float64 with that shape.
  Borrowed(const nb::handle& given, std::initializer_list<int> shape) {
    static const nb::object &kind = numpy_attribute("ndarray"), &dtype = interned("dtype");
    static const nb::object& doubles = *new nb::object(numpy_attribute("dtype")("float64"));
    if (!given.type().is(kind) || !nb::getattr(given, dtype).is(doubles)) return;
    if (PyObject_GetBuffer(given.ptr(), &view_, PyBUF_C_CONTIGUOUS)) {
      PyErr_Clear();
      return;
    }
    is_held_ = true;
    bool is_right = view_.ndim == static_cast<int>(shape.size());
    const Py_ssize_t* at = view_.shape;
    for (const int count : shape) is_right = is_right && *at++ == count;
    if (is_right) data = static_cast<const double*>(view_.buf);
  }
  Borrowed(const Borrowed&) = delete;
  ~Borrowed() {
    if (is_held_) PyBuffer_Release(&view_);
  }
  const double* data = nullptr;

 private:
  Py_buffer view_;
  bool is_held_ = false;
};

// An array of a shape, to be filled at `data`. numpy makes it, in a third of the time of an export.
inline NumpyArray array_of(std::initializer_list<size_t> shape, double*& data) {
  static const nb::object& empty = numpy_attribute("empty");
  nb::object sizes = nb::steal(PyTuple_New(shape.size()));
  Py_ssize_t axis = 0;
  for (const size_t count : shape)
    PyTuple_SetItem(sizes.ptr(), axis++, PyLong_FromSize_t(count));
  nb::object array = empty(sizes);
  Py_buffer view;
  if (PyObject_GetBuffer(array.ptr(), &view, PyBUF_WRITABLE)) nb::raise_python_error();
  data = static_cast<double*>(view.buf);
  PyBuffer_Release(&view);
  return array;
}

inline NumpyArray array_of(std::initializer_list<size_t> shape, const double* from) {
  size_t size = 1;
  for (const size_t count : shape) size *= count;
  double* to;
  NumpyArray numbers = array_of(shape, to);
  std::copy(from, from + size, to);
  return numbers;
}

inline NumpyArray array_of(const Vector& from) { return array_of({from.size()}, from.data()); }

// The same, which cannot be written to.
template <class Number>
NumpyArray read_only(const std::vector<Number>& from) {
  auto* kept = new std::vector<Number>(from);
  const nb::capsule owner(kept, [](void* p) noexcept {
    delete static_cast<std::vector<Number>*>(p);
  });
  return nb::cast(nb::ndarray<nb::numpy, const Number>(kept->data(), {kept->size()}, owner));
}

inline NumpyArray array_of(const std::vector<Vec3>& points) {
  static_assert(sizeof(Vec3) == 3 * sizeof(double));
  return array_of({points.size(), 3}, points.empty() ? nullptr : &points[0].x);
}

inline NumpyArray array_of(const Pose& pose) {
  double m[16];
  write_pose(pose, m);
  return array_of({4, 4}, m);
}

inline NumpyArray array_of(const std::vector<Pose>& poses) {
  Vector m(16 * poses.size());
  for (size_t i = 0; i < poses.size(); ++i) write_pose(poses[i], m.data() + 16 * i);
  return array_of({poses.size(), 4, 4}, m.data());
}

}  // namespace handmap
