// The module of Python: flat arrays in, one call a sample.
#include "bind.hpp"
#include "build.hpp"

NB_MODULE(_core, m) {
  using namespace handmap;
  package() = nb::cast<std::string>(m.attr("__name__").attr("rpartition")(".")[0]);
  m.attr("SOURCES") = HANDMAP_SOURCES;
  // Caches of Python modules may outlive this one when the interpreter ends.
  nb::set_leak_warnings(false);
  nb::register_exception_translator([](const std::exception_ptr& error, void*) {
    try {
      std::rethrow_exception(error);
    } catch (const BusyError&) {
      PyErr_SetNone(module_of("errors").object("MapperBusyError").ptr());
    }
  });
  // Classes come after their bases.
  bind_models(m);
  bind_hands(m);
  bind_gate(m);
  bind_ik(m);
  bind_samples(m);
  bind_robot(m);
  bind_checks(m);
  bind_measures(m);
}
