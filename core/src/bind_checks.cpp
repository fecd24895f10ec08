// The clocks and the guard of a stream, the check of its input, and its smoother.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include "bind.hpp"
#include "build_guard.hpp"
#include "build_smoothing.hpp"

using namespace nb::literals;

namespace handmap {
namespace {

// Copies and pickles of small states, which are their bytes.
template <class State>
void bind_copies(nb::class_<State>& bound) {
  bound.def("__getstate__", [](const State& state) { return bytes_of(state); });
  bound.def("__setstate__", [](State& state, const nb::bytes& bytes) {
    new (&state) State();
    put_back(bytes, state);
  });
}

std::pair<ArrivalCredit, double> spend(ArrivalCredit credit, double dt, double arrival) {
  const double granted = credit.spend(dt, arrival);
  return {credit, granted};
}

std::optional<double> update_rate(RateCheck& check, double stamp, double arrival) {
  const double rate = check.update(stamp, arrival);
  return std::isnan(rate) ? std::nullopt : std::optional<double>(rate);
}

// The motion from a track to a sample.
struct Moved {
  Track track;
  Change change;
};

Moved measure_change(const Track& track, const Track& sample, double dt) {
  Moved moved{sample, {}};
  moved.change = change_between(track, moved.track, dt);
  return moved;
}

void bind_clocks(nb::module_& m) {
  nb::class_<SampleClock> clock(m, "SampleClock");
  clock.def(nb::init<>())
      .def("advance", &SampleClock::advance, "stamp"_a)
      .def("at", &SampleClock::at, "stamp"_a)
      .def_ro("period", &SampleClock::period)
      .def_prop_ro("rule", [](const SampleClock& now) { return kRuleNames[now.rule]; })
      .def_ro("elapsed", &SampleClock::elapsed)
      .def_ro("dt", &SampleClock::dt)
      .def_prop_ro("is_idle", &SampleClock::is_idle)
      .def_prop_ro("is_set_back", &SampleClock::is_set_back)
      .def_prop_ro("shortest", &SampleClock::shortest);
  bind_copies(clock);
  nb::class_<ArrivalCredit> credit(m, "ArrivalCredit");
  credit.def(nb::init<>()).def("spend", &spend, "dt"_a, "arrival"_a);
  bind_copies(credit);
  nb::class_<RateCheck>(m, "RateCheck")
      .def(nb::init<>())
      .def("grant", &RateCheck::grant, "dt"_a, "arrival"_a)
      .def("update", &update_rate, "stamp"_a, "arrival"_a);
}

void bind_motion(nb::module_& m) {
  nb::class_<Track>(m, "Track")
      .def("__init__",
           [](Track* self, double time, const Array& landmarks) {
             new (self) Track(first_track(time, landmarks_from(landmarks)));
           },
           "time"_a, "landmarks"_a)
      .def_prop_ro("velocity", [](const Track& track) { return array_of({3}, &track.velocity.x); })
      .def_prop_ro("turning", [](const Track& track) { return array_of({3}, &track.turning.x); })
      .def_prop_ro("bending", [](const Track& track) {
        return array_of({kLandmarks, 3}, &track.bending[0].x);
      });
  nb::class_<Moved>(m, "Change")
      .def_ro("track", &Moved::track)
      .def_prop_ro("sizes",
                   [](const Moved& moved) { return array_of({kSizes}, moved.change.sizes); })
      .def_prop_ro("noise", [](const Moved& moved) { return moved.change.noise; })
      .def_prop_ro("is_mirrored", [](const Moved& moved) { return moved.change.is_mirrored; });
  m.def("change_between", &measure_change, "track"_a, "sample"_a, "dt"_a);
}

nb::tuple names_of(const nb::list& names) { return nb::tuple(names); }

// Numbers of the checks that others need too.
void bind_numbers(nb::module_& m) {
  nb::list rules, mistakes, bones, neighbours;
  for (const char* name : kRuleNames) rules.append(name);
  for (const MistakeName& each : kMistakes)
    if (each.rule != kNothing) mistakes.append(each.name);
  for (int k = 0; k < kFixed; ++k)
    (k < kBones ? bones : neighbours).append(nb::make_tuple(kEnds[k][0], kEnds[k][1]));
  m.attr("RULES") = names_of(rules);
  m.attr("MISTAKES") = names_of(mistakes);
  m.attr("BONES") = names_of(bones);
  m.attr("NEIGHBOURS") = names_of(neighbours);
  m.attr("LONGEST_STEP") = kLongestStep;
  m.attr("BEHIND") = kBehind;
  m.attr("GAP") = kGap;
  m.attr("FROZEN_AFTER") = kFrozenAfter;
  m.attr("SETTLE_TIME") = kSettleTime;
  m.attr("UNPROVEN_SPEED") = kUnprovenSpeed;
  m.attr("PALM_RATIOS") = nb::make_tuple(kPalmRatios[0], kPalmRatios[1]);
  m.attr("HAND_LENGTHS") = nb::make_tuple(kHandLengths[0], kHandLengths[1]);
  m.attr("SAMPLE_STEPS") = nb::make_tuple(kSampleSteps[0], kSampleSteps[1]);
  m.attr("BACKWARDS") = kBackwards;
  m.attr("SURE_SIDE") = kSureSide;
  m.attr("RESIZED") = kResized;
  m.attr("FIRST_SIZES") = kFirstSizes;
  constexpr Smoothing kSmoothing;
  m.attr("SMOOTHING") = nb::make_tuple(kSmoothing.acceleration, kSmoothing.speed_gain);
}

}  // namespace

void bind_checks(nb::module_& m) {
  bind_numbers(m);
  bind_clocks(m);
  bind_motion(m);
  nb::class_<LandmarkOrders>(m, "LandmarkOrders")
      .def(nb::new_(&make_orders), "orders"_a);
  nb::class_<Samples>(m, "Samples")
      .def(nb::init<Array, Array, Flags, std::optional<Array>, std::optional<Array>>(), "time"_a,
           "landmarks"_a, "valid"_a, "confidence"_a.none() = nb::none(),
           "wrist"_a.none() = nb::none());
  nb::class_<PythonInputCheck>(m, "InputCheck")
      .def(nb::init<const std::string&, std::shared_ptr<const LandmarkOrders>>(), "side"_a,
           "orders"_a)
      .def("save", exclusively(&PythonInputCheck::save))
      .def("restore", exclusively(&PythonInputCheck::restore), "saved"_a)
      .def("update", exclusively(&PythonInputCheck::update), "time"_a, "landmarks"_a,
           "wrist"_a.none() = nb::none())
      .def("alert", exclusively(&PythonInputCheck::alert))
      .def("finish", exclusively(&PythonInputCheck::finish))
      .def("examine", exclusively(&PythonInputCheck::examine), "samples"_a)
      .def("finding", exclusively(&PythonInputCheck::finding))
      .def("is_wrist_proven", exclusively(&PythonInputCheck::is_wrist_proven));
  nb::class_<PythonGuard>(m, "StreamGuard")
      .def("__init__",
           [](PythonGuard* self, const nb::bytes& model,
              std::shared_ptr<const LandmarkOrders> orders) {
             new (self) PythonGuard(model_of<GuardModel>(model), std::move(orders));
           },
           "model"_a, "orders"_a)
      .def("save", exclusively(&PythonGuard::save))
      .def("restore", exclusively(&PythonGuard::restore), "saved"_a)
      .def("forget", exclusively(&PythonGuard::forget))
      .def("check", exclusively(&PythonGuard::check), "time"_a, "landmarks"_a, "wrist"_a.none(),
           "valid"_a, "confidence"_a, "arrival"_a.none())
      .def("holds", exclusively(&PythonGuard::holds), "samples"_a);
  nb::class_<PythonSmoother>(m, "Smoother")
      .def(nb::init<std::optional<double>, double>(), "acceleration"_a.none(), "speed_gain"_a)
      .def("save", exclusively(&PythonSmoother::save))
      .def("restore", exclusively(&PythonSmoother::restore), "saved"_a)
      .def("smooth", exclusively(&PythonSmoother::smooth), "pose"_a, "dt"_a)
      .def("wait", exclusively(&PythonSmoother::wait), "dt"_a)
      .def("restart", exclusively(&PythonSmoother::restart))
      .def("forget", exclusively(&PythonSmoother::forget));
}

}  // namespace handmap
