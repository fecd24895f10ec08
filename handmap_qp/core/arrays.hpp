// Numbers of the core as arrays of Python, which own them.
#pragma once

#include "build.hpp"

namespace handmap {

using NumpyArray = nb::object;

// An array of a shape, to be filled at `data`. numpy makes it, in a third of the time of an export.
inline NumpyArray array_of(std::initializer_list<size_t> shape, double*& data) {
  static const nb::object& empty = *new nb::object(nb::module_::import_("numpy").attr("empty"));
  nb::list sizes;
  for (const size_t count : shape) sizes.append(count);
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

inline NumpyArray array_of(const std::vector<Vec3>& points) {
  static_assert(sizeof(Vec3) == 3 * sizeof(double));
  return array_of({points.size(), 3}, points.empty() ? nullptr : &points[0].x);
}

inline void write_pose(const Pose& pose, double* m) {
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) m[4 * i + j] = pose.R(i, j);
    m[4 * i + 3] = pose.p[i];
  }
  m[12] = m[13] = m[14] = 0.0;
  m[15] = 1.0;
}

inline NumpyArray array_of(const Pose& pose) {
  double m[16];
  write_pose(pose, m);
  return array_of({4, 4}, m);
}

}  // namespace handmap
