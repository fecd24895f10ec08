// The module of Python: flat arrays in, one call a sample.
#include "bind.hpp"
#include "arrays.hpp"

using namespace nb::literals;

namespace {

// Raise an exception of this class where a thread enters an object on which another one works.
void raise_if_busy(const nb::type_object& error) {
  if (!PyExceptionClass_Check(error.ptr())) throw std::invalid_argument("no class of exceptions");
  nb::register_exception_translator(
      [](const std::exception_ptr& thrown, void* kind) {
        try {
          std::rethrow_exception(thrown);
        } catch (const handmap::BusyError&) {
          PyErr_SetNone(static_cast<PyObject*>(kind));
        }
      },
      error.inc_ref().ptr());
}

}  // namespace

NB_MODULE(_core, m) {
  using namespace handmap;
  m.attr("SOURCES") = HANDMAP_SOURCES;
  // Caches of Python modules may outlive this one when the interpreter ends.
  nb::set_leak_warnings(false);
  m.def("raise_if_busy", &raise_if_busy, "error"_a);
  // Classes come after their bases.
  bind_models(m);
  bind_hands(m);
  bind_gate(m);
  bind_steps(m);
  bind_ik(m);
  bind_samples(m);
  bind_robot(m);
  bind_checks(m);
  bind_measures(m);
}
