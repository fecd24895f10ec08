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
      .def("save", exclusively(&PythonInputCheck::save))
      .def("update", exclusively(&PythonInputCheck::update), "time"_a, "landmarks"_a,
           "wrist"_a.none() = nb::none())
      .def("alert", exclusively(&PythonInputCheck::alert))
      .def("finish", exclusively(&PythonInputCheck::finish))
      .def("examine", exclusively(&PythonInputCheck::examine), "recording"_a)
      .def("finding", exclusively(&PythonInputCheck::finding))
      .def("is_wrist_proven", exclusively(&PythonInputCheck::is_wrist_proven));
  nb::class_<PythonGuard>(m, "StreamGuard")
      .def(nb::init<const nb::object&>())
      .def("save", exclusively(&PythonGuard::save))
      .def("forget", exclusively(&PythonGuard::forget))
      .def("check", exclusively(&PythonGuard::check), "sample"_a, "arrival"_a.none())
      .def("holds", exclusively(&PythonGuard::holds), "recording"_a)
      .def("judge", exclusively(&PythonGuard::judge), "recording"_a);
  nb::class_<PythonSmoother>(m, "Smoother")
      .def(nb::init<const nb::object&>())
      .def("save", exclusively(&PythonSmoother::save))
      .def("smooth", exclusively(&PythonSmoother::smooth))
      .def("wait", exclusively(&PythonSmoother::wait))
      .def("restart", exclusively(&PythonSmoother::restart))
      .def("forget", exclusively(&PythonSmoother::forget));
  m.attr("RULES") = rule_names();
}

}  // namespace handmap
