// The checks of samples, the guard of a stream, and its smoother.
#include <nanobind/stl/optional.h>

#include "bind.hpp"
#include "build_guard.hpp"
#include "build_smoothing.hpp"

using namespace nb::literals;

namespace handmap {

void bind_checks(nb::module_& m) {
  nb::class_<PythonInputCheck>(m, "InputCheck")
      .def(nb::init<const nb::object&>())
      .def("save", &PythonInputCheck::save)
      .def("update", &PythonInputCheck::update, "time"_a, "landmarks"_a,
           "wrist"_a.none() = nb::none())
      .def("alert", &PythonInputCheck::alert)
      .def("finish", &PythonInputCheck::finish)
      .def("examine", &PythonInputCheck::examine, "recording"_a)
      .def("finding", &PythonInputCheck::finding)
      .def("is_wrist_proven", &PythonInputCheck::is_wrist_proven);
  nb::class_<PythonGuard>(m, "StreamGuard")
      .def(nb::init<const nb::object&>())
      .def("save", &PythonGuard::save)
      .def("forget", &PythonGuard::forget)
      .def("check", &PythonGuard::check, "sample"_a, "arrival"_a.none())
      .def("holds", &PythonGuard::holds, "recording"_a)
      .def("judge", &PythonGuard::judge, "recording"_a);
  nb::class_<PythonSmoother>(m, "Smoother")
      .def(nb::init<const nb::object&>())
      .def("save", &PythonSmoother::save)
      .def("smooth", &PythonSmoother::smooth)
      .def("wait", &PythonSmoother::wait)
      .def("restart", &PythonSmoother::restart)
      .def("forget", &PythonSmoother::forget);
  m.attr("RULES") = rule_names();
}

}  // namespace handmap
