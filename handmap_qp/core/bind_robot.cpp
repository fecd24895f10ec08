// Commands of a robot with several hands.
#include <nanobind/stl/optional.h>

#include "bind.hpp"
#include "robot.hpp"

using namespace nb::literals;

namespace handmap {

void bind_robot(nb::module_& m) {
  nb::class_<RobotMover>(m, "RobotMover")
      .def(nb::init<nb::object, const nb::object&, const nb::list&, nb::dict, double>(), "ik"_a,
           "robot"_a, "pinching"_a, "leaders"_a, "turns_in"_a)
      .def("__reduce__", &without_copy<RobotMover>)
      .def("map", &RobotMover::map, "reader"_a, "numbers"_a, "wrists"_a, "when"_a, "base"_a)
      .def("move", &RobotMover::move, "base"_a, "when"_a);
}

}  // namespace handmap
