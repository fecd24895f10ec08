// Steps of a robot, as numbers: see ik.IkResult.
#include <nanobind/stl/string.h>

#include "arrays.hpp"
#include "bind.hpp"

using namespace nb::literals;

namespace handmap {

void bind_steps(nb::module_& m) {
  nb::class_<Step>(m, "Step")
      .def_prop_ro("status", [](const Step& step) { return name_of(step.result.status); })
      .def_prop_ro("points", [](const Step& step) { return array_of(step.result.points); })
      .def_prop_ro("targets", [](const Step& step) { return array_of(step.result.targets); })
      .def_prop_ro("q", [](const Step& step) { return array_of(step.motion.q); })
      .def_prop_ro("wrists", [](const Step& step) { return array_of(step.result.wrists); })
      .def_prop_ro("displacement",
                   [](const Step& step) { return read_only(step.result.displacement); })
      .def_prop_ro("active", [](const Step& step) { return read_only(step.result.active); })
      .def_prop_ro("iterations", [](const Step& step) { return step.result.iterations; })
      .def_prop_ro("last_step", [](const Step& step) { return step.result.last_step; })
      .def_prop_ro("held_by", [](const Step& step) { return step.result.held_by; });
}

}  // namespace handmap
