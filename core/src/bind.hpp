// What Python sees of the core, in parts that compile beside each other.
#pragma once

#include <nanobind/nanobind.h>

namespace nb = nanobind;

namespace handmap {

void bind_models(nb::module_& m);
void bind_hands(nb::module_& m);
void bind_gate(nb::module_& m);
void bind_ik(nb::module_& m);
void bind_steps(nb::module_& m);
void bind_samples(nb::module_& m);
void bind_robot(nb::module_& m);
void bind_checks(nb::module_& m);
void bind_measures(nb::module_& m);

}  // namespace handmap
