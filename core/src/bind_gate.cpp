// The gate: every displacement of a robot passes it, whoever asks.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include "bind.hpp"
#include "handmap/ik_models.hpp"
#include "mapper.hpp"

using namespace nb::literals;

namespace handmap {
namespace {

void make_gate(Gate* self, const Tree& tree, const nb::bytes& limits,
               std::shared_ptr<const PairBounds> pairs,
               const std::optional<nb::bytes>& collisions) {
  Gate& gate = *new (self) Gate(tree);
  set_gate(gate, model_of<BoxLimits>(limits), std::move(pairs),
           optional_model<CollisionModel>(collisions));
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
                   new_stamp(), gate.motion.commands});
}

// Take over the motion of another gate of the same robot.
void follow_gate(Gate& gate, const Gate& leader) {
  expect(leader.tree.nq == gate.tree.nq && leader.tree.size == gate.tree.size,
         "a gate of another robot");
  const Reading from(leader);
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

// One QP whose rows are those of a gate, and which is posed and solved elsewhere.
class PosedRows {
 public:
  // For the next command of a gate that keeps shapes apart, with bounds of the displacement.
  PosedRows(Gate& gate, const nb::object& when, const Array& lower, const Array& upper,
            const std::optional<Array>& margins)
      : gate_(gate), interval_(gate.motion.next(when_from(when))), stamp_(gate.motion.stamp), lower_(vector_of(lower)),
        upper_(vector_of(upper)) {
    for (const Array* each : {&lower, &upper}) expect_size(*each, gate.tree.size, "bounds");
    expect(gate.pairs != nullptr, "a gate that keeps no shapes apart");
    if (margins) {
      expect_size(*margins, gate.pairs->size(), "margins");
      margins_ = vector_of(*margins);
    }
    const Work posing(gate);
    gate.rows(interval_, margins_, lower_, upper_, Vector(gate.tree.size, 0.0), rows_, h_);
  }

  // G and h behind a part of the displacement, which never contradict the rest of its bounds.
  nb::tuple behind(const Array& so_far) {
    expect_size(so_far, gate_.tree.size, "so_far");
    expect_same_command();
    const Work posing(gate_);
    const Vector before = vector_of(so_far);
    Vector least = lower_, most = upper_;
    for (size_t i = 0; i < before.size(); ++i) {
      least[i] -= before[i];
      most[i] -= before[i];
    }
    return loosened(least, most, before);
  }

  // The same from the start, with what the end of a displacement meets; none if it meets nothing.
  std::optional<nb::tuple> at_end(const Array& displacement) {
    expect_size(displacement, gate_.tree.size, "displacement");
    expect_same_command();
    const Work posing(gate_);
    if (!gate_.add_rows_at_end(vector_of(displacement), rows_)) return {};
    return loosened(lower_, upper_, Vector(gate_.tree.size, 0.0));
  }

  // As of `Gate.admit`; `around` takes G and h with what meets on the line of the wanted displacement, and
  // returns another one.
  NumpyArray admit(const Array& wanted, const Array& first, const nb::callable& around) {
    expect_size(wanted, gate_.tree.size, "wanted");
    expect_size(first, gate_.tree.size, "first");
    expect_same_command();
    const Work moving(gate_);
    gate_.was_moved();
    Vector other;
    const auto find = [&]() -> const Vector& {
      gate_.add_rows_on_line(rows_);
      other = vector_of(nb::cast<Array>(around(loosened(lower_, upper_, Vector(lower_.size(), 0.0)))));
      expect(other.size() == lower_.size(), "wrong size of another displacement");
      return other;
    };
    gate_.admit(vector_of(wanted), vector_of(first), interval_, find, kTries);
    return array_of(gate_.motion.displacement);
  }

  // The pair whose row a step is pressed against most; -1 for none. See `Gate::pressed_pair`.
  int pressed_pair(const Array& slope, const Array& step) const {
    expect_size(slope, gate_.tree.size, "slope");
    expect_size(step, gate_.tree.size, "step");
    return gate_.pressed_pair(rows_, h_, vector_of(slope), vector_of(step));
  }

 private:
  Gate& gate_;
  const Interval interval_;
  const std::uint64_t stamp_;
  const Vector lower_, upper_;
  Vector margins_;
  Rows rows_;
  Vector h_;

  void expect_same_command() const {
    expect(gate_.motion.stamp == stamp_, "rows of another command");
  }
  nb::tuple loosened(const Vector& lower, const Vector& upper, const Vector& so_far) {
    gate_.loosen(rows_, interval_, lower, upper, so_far, h_);
    const size_t count = static_cast<size_t>(rows_.count), size = lower.size();
    return nb::make_tuple(array_of({count, size}, rows_.G.data()), array_of(h_));
  }
};

NumpyArray brake(Gate& gate, const nb::object& when) {
  gate.brake(when_from(when));
  return array_of(gate.motion.displacement);
}

bool advance(Gate& gate, const Array& goal, const nb::object& when, double share, bool stops) {
  expect_size(goal, gate.tree.nq, "goal");
  return gate.advance(vector_of(goal), when_from(when), share, stops);
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
  nb::class_<Gate>(m, "Gate")
      .def("__init__", &make_gate, "tree"_a, "limits"_a,
           "pairs"_a.none() = nb::none(), "collisions"_a.none() = nb::none())
      .def_ro("held_by", &Gate::held_by)
      .def_prop_ro("stamp", [](const Gate& gate) { return gate.motion.stamp; })
      .def_prop_ro("commands", [](const Gate& gate) { return gate.motion.commands; })
      .def_prop_ro("time", [](const Gate& gate) { return gate.motion.time; })
      .def_prop_ro("motion", reading(&motion_of))
      .def("set_motion", exclusively(&set_motion), "q"_a, "displacement"_a, "dt"_a, "stop_times"_a,
           "time"_a = 0.0)
      .def("follow", exclusively(&follow_gate), "leader"_a)
      .def("interval", reading(&interval), "when"_a)
      .def("bounds", exclusively(&bounds), "when"_a, "share"_a = 1.0)
      .def("advance", exclusively(&advance), "goal"_a, "when"_a, "share"_a = 1.0, "stops"_a = false)
      .def("admit", exclusively(&admit), "wanted"_a, "first"_a, "when"_a)
      .def("brake", exclusively(&brake), "when"_a);
  nb::class_<PosedRows>(m, "PosedRows")
      .def(nb::init<Gate&, const nb::object&, const Array&, const Array&,
                    const std::optional<Array>&>(),
           nb::keep_alive<1, 2>(), "gate"_a, "when"_a, "lower"_a, "upper"_a,
           "margins"_a.none() = nb::none())
      .def("behind", &PosedRows::behind, "so_far"_a)
      .def("at_end", &PosedRows::at_end, "displacement"_a)
      .def("admit", &PosedRows::admit, "wanted"_a, "first"_a, "around"_a)
      .def("pressed_pair", &PosedRows::pressed_pair, "slope"_a, "step"_a);
}

}  // namespace handmap
