// The gate: every displacement of a robot passes it, whoever asks.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include "bind.hpp"
#include "mapper.hpp"

using namespace nb::literals;

namespace handmap {
namespace {

// Of a hand and its tree, `BoxLimits`, and a `CollisionLimit` or None.
void make_gate(Gate* self, const Tree& tree, const nb::object& hand, const nb::object& limits,
               const nb::object& collisions) {
  Gate& gate = *new (self) Gate(tree);
  set_gate(gate, Fields(hand), Fields(limits), collisions);
}

// What a `Motion` of Python is made of.
nb::tuple motion_of(Gate& gate) {
  const Motion& motion = gate.motion;
  return nb::make_tuple(array_of(motion.q), array_of(motion.displacement), motion.dt,
                        array_of(motion.stop_times), motion.time);
}

void set_motion(Gate& gate, const Array& q, const Array& displacement, double dt,
                const Array& stop_times, double time) {
  expect_size(q, gate.tree.nq, "q");
  expect_size(displacement, gate.tree.size, "displacement");
  expect_size(stop_times, gate.tree.size, "stop_times");
  gate.set_motion({vector_of(q), vector_of(displacement), dt, vector_of(stop_times), time,
                   new_stamp()});
}

// Take over the motion of another gate of the same robot.
void follow_gate(Gate& gate, const Gate& leader) {
  expect(leader.tree.nq == gate.tree.nq && leader.tree.size == gate.tree.size,
         "a gate of another robot");
  gate.set_motion(leader.motion);
}

nb::tuple interval(Gate& gate, const nb::object& when) {
  const Interval next = gate.motion.next(when_from(when));
  return nb::make_tuple(next.dt, next.granted, next.time);
}

NumpyArray bounds(Gate& gate, const nb::object& when, double share) {
  Vector lower, upper;
  gate.bounds(gate.motion.next(when_from(when)), share, lower, upper);
  append(upper, lower);
  return array_of({2, upper.size()}, lower.data());
}

NumpyArray admit(Gate& gate, const Array& wanted, const Array& first, const nb::object& when) {
  expect_size(wanted, gate.tree.size, "wanted");
  expect_size(first, gate.tree.size, "first");
  gate.admit(vector_of(wanted), vector_of(first), gate.motion.next(when_from(when)));
  return array_of(gate.motion.displacement);
}

NumpyArray brake(Gate& gate, const nb::object& when) {
  gate.brake(when_from(when));
  return array_of(gate.motion.displacement);
}

bool advance(Gate& gate, const Array& goal, const nb::object& when, double share, bool stops) {
  expect_size(goal, gate.tree.nq, "goal");
  return gate.advance(vector_of(goal), when_from(when), share, stops);
}

// Rows G x <= h of the next displacement, behind a part of it; none without pairs of shapes. They never
// contradict its bounds.
std::optional<nb::tuple> rows(Gate& gate, const nb::object& when, const Array& lower,
                              const Array& upper, const Array& so_far,
                              const std::optional<Array>& margins) {
  for (const Array* each : {&lower, &upper, &so_far}) expect_size(*each, gate.tree.size, "bounds");
  if (!gate.pairs) return {};
  if (margins) expect_size(*margins, gate.pairs->size(), "margins");
  Rows found;
  Vector h;
  gate.rows(gate.motion.next(when_from(when)), margins ? vector_of(*margins) : Vector(),
            vector_of(lower), vector_of(upper), vector_of(so_far), found, h);
  const size_t count = static_cast<size_t>(found.count), size = static_cast<size_t>(gate.tree.size);
  return nb::make_tuple(array_of({count, size}, found.G.data()), array_of(h));
}

// The pair whose row a step is pressed against most; -1 for none. See `Gate::pressed_pair`.
int pressed_pair(Gate& gate, const Array& G, const Array& h, const Array& slope, const Array& step) {
  expect_size(G, h.size() * gate.tree.size, "G");
  expect_size(slope, gate.tree.size, "slope");
  expect_size(step, gate.tree.size, "step");
  expect(gate.pairs && h.size() <= gate.pairs->row_count(), "rows of another posture");
  const Rows rows{static_cast<int>(h.size()), vector_of(G), vector_of(h)};
  return gate.pressed_pair(rows, rows.h, vector_of(slope), vector_of(step));
}

// What rows G x <= h are loosened to where they contradict each other or a box.
NumpyArray loosened(const Array& G, const Array& h, const Array& lower, const Array& upper,
                    double stopping, const Array& so_far) {
  expect_size(G, h.size() * lower.size(), "G");
  expect_size(upper, lower.size(), "upper");
  expect_size(so_far, lower.size(), "so_far");
  const Rows rows{static_cast<int>(h.size()), vector_of(G), vector_of(h)};
  Vector found;
  Feasible().loosen(rows, vector_of(lower), vector_of(upper), stopping, vector_of(so_far), found);
  return array_of(found);
}

}  // namespace

void bind_gate(nb::module_& m) {
  m.def("loosened", &loosened, "G"_a, "h"_a, "lower"_a, "upper"_a, "stopping"_a, "so_far"_a);
  m.def("braking_displacement", &BoxLimits::braking_displacement, "distance"_a, "change"_a);
  nb::class_<Gate>(m, "Gate")
      .def("__init__", &make_gate, "tree"_a, "hand"_a, "limits"_a, "collisions"_a.none())
      .def_ro("held_by", &Gate::held_by)
      .def_prop_ro("stamp", [](const Gate& gate) { return gate.motion.stamp; })
      .def_prop_ro("time", [](const Gate& gate) { return gate.motion.time; })
      .def_prop_ro("motion", exclusively(&motion_of))
      .def("set_motion", exclusively(&set_motion), "q"_a, "displacement"_a, "dt"_a, "stop_times"_a,
           "time"_a = 0.0)
      .def("follow", exclusively(&follow_gate), "leader"_a)
      .def("interval", exclusively(&interval), "when"_a)
      .def("bounds", exclusively(&bounds), "when"_a, "share"_a = 1.0)
      .def("rows", exclusively(&rows), "when"_a, "lower"_a, "upper"_a, "so_far"_a,
           "margins"_a.none() = nb::none())
      .def("pressed_pair", exclusively(&pressed_pair), "G"_a, "h"_a, "slope"_a, "step"_a)
      .def("advance", exclusively(&advance), "goal"_a, "when"_a, "share"_a = 1.0, "stops"_a = false)
      .def("admit", exclusively(&admit), "wanted"_a, "first"_a, "when"_a)
      .def("brake", exclusively(&brake), "when"_a);
}

}  // namespace handmap
