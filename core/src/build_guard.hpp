// The guard and the input check for Python: what they take, and their verdicts and findings as numbers.
#pragma once

#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <cstring>
#include <optional>
#include <tuple>

#include "arrays.hpp"
#include "handmap/guard.hpp"

namespace handmap {

using Flags = nb::ndarray<const bool, nb::c_contig, nb::device::cpu>;

inline Landmarks landmarks_from(const Array& points) {
  expect_size(points, 3 * kLandmarks, "landmarks");
  return landmarks_of(points.data());
}

// Rule, mistake, number and index; see human.findings.Finding.
using FindingNumbers = std::tuple<const char*, const char*, double, int>;
// In the order of human.sample.Verdict.
using VerdictNumbers = std::tuple<const char*, bool, bool, double, double,
                                  std::optional<FindingNumbers>, double, double>;

inline std::optional<FindingNumbers> numbers_of(const Finding& finding) {
  if (finding.is_none()) return {};
  return FindingNumbers{kRuleNames[finding.rule()],
                        kMistakes[static_cast<int>(finding.mistake)].name, finding.number,
                        finding.which};
}

inline VerdictNumbers numbers_of(const Verdict& verdict) {
  return {kRuleNames[verdict.rule], verdict.is_held,     verdict.is_return,
          verdict.dt,               verdict.consistency, numbers_of(verdict.finding),
          verdict.lost,             verdict.time};
}

// State as bytes, to be put back in a process that has the same core.
template <class State>
nb::bytes bytes_of(const State& state) {
  static_assert(std::is_trivially_copyable_v<State>);
  return nb::bytes(reinterpret_cast<const char*>(&state), sizeof(State));
}
template <class State>
void put_back(const nb::bytes& given, State& state) {
  if (given.size() != sizeof(State)) throw std::invalid_argument("a state of another core");
  std::memcpy(static_cast<void*>(&state), given.c_str(), sizeof(State));
}

// The same of a state that says whether it can be one.
template <class State>
void restore_state(const nb::bytes& bytes, State& state) {
  State restored{};
  put_back(bytes, restored);
  expect(restored.is_sound(), "a damaged state");
  state = restored;
}

// The columns of a `Recording`.
class Samples {
 public:
  const size_t count;

  Samples(Array time, Array landmarks, Flags valid, std::optional<Array> confidence,
          std::optional<Array> wrist)
      : count(time.size()), time_(std::move(time)), landmarks_(std::move(landmarks)),
        valid_(std::move(valid)), confidence_(std::move(confidence)), wrist_(std::move(wrist)) {
    expect_size(landmarks_, 3 * kLandmarks * count, "landmarks");
    expect(valid_.size() == count, "wrong size of valid");
    if (confidence_) expect_size(*confidence_, count, "confidence");
    if (wrist_) expect_size(*wrist_, 16 * count, "wrist");
  }
  const double* times() const { return time_.data(); }
  const double* landmarks() const { return landmarks_.data(); }
  const bool* valid() const { return valid_.data(); }
  size_t valid_count() const {
    return static_cast<size_t>(std::count(valid(), valid() + count, true));
  }
  const double* landmarks_at(size_t t) const { return landmarks() + 3 * kLandmarks * t; }
  const double* wrist_at(size_t t) const { return wrist_ ? wrist_->data() + 16 * t : nullptr; }
  StreamSample sample(size_t t) const {
    return {time_.data()[t],
            landmarks_at(t),
            wrist_at(t),
            valid()[t],
            confidence_ ? confidence_->data()[t] : 1.0,
            kNaN};
  }

 private:
  Array time_, landmarks_;
  Flags valid_;
  std::optional<Array> confidence_, wrist_;
};

// An `InputCheck` for Python.
class PythonInputCheck : public Exclusive {
 public:
  PythonInputCheck(const std::string& side, std::shared_ptr<const LandmarkOrders> orders)
      : check_(sign_of(side), std::move(orders)) {}

  nb::bytes save() const { return bytes_of(check_.state); }
  void restore(const nb::bytes& saved) { restore_state(saved, check_.state); }

  std::optional<FindingNumbers> update(double time, const Array& landmarks,
                                       const std::optional<Array>& wrist) {
    if (wrist) expect_size(*wrist, 16, "wrist");
    return numbers_of(take(time, landmarks_from(landmarks), wrist ? wrist->data() : nullptr));
  }

  // Take a whole recording; what is wrong in a quarter of its valid samples or more.
  std::optional<FindingNumbers> examine(const Samples& samples) {
    const nb::gil_scoped_release no_gil;
    return numbers_of(examined(samples));
  }

  std::optional<FindingNumbers> finish() { return numbers_of(check_.finish()); }
  std::optional<FindingNumbers> finding() const { return numbers_of(check_.state.finding); }
  bool is_wrist_proven() const { return check_.state.seen.wrist.is_proven; }
  void alert() { check_.alert(); }

 private:
  InputCheck check_;

  const Finding& take(double time, const Landmarks& landmarks, const double* wrist) {
    Pose pose;
    if (wrist) pose = pose_of(wrist);
    return check_.update(time, landmarks, wrist ? &pose : nullptr);
  }

  Finding examined(const Samples& samples) {
    std::vector<size_t> seen;
    for (size_t t = 0; t < samples.count; ++t)
      if (samples.valid()[t]) seen.push_back(t);
    if (seen.empty()) return {};
    size_t found = 0;
    for (const size_t t : seen) {
      const Finding& finding =
          take(samples.times()[t], landmarks_of(samples.landmarks_at(t)), samples.wrist_at(t));
      if (finding.is_none()) continue;
      ++found;
      const bool is_much = found >= kRefusedShare * seen.size();
      if (is_much || finding.rule() == kTime) return finding;
    }
    const Finding last = check_.finish();
    const double duration = samples.times()[seen.back()] - samples.times()[seen.front()];
    return duration <= kShortRecording ? last : Finding{};
  }
};

// The sample of a hand that Python gives, whose arrays it borrows.
class GivenSample {
 public:
  StreamSample sample;

  // `arrival` is none for a recording; see human.sample.HumanSample.
  GivenSample(double time, const nb::handle& landmarks, const nb::handle& wrist, bool valid,
              double confidence, std::optional<double> arrival)
      : landmarks_(landmarks, {kLandmarks, 3}) {
    if (!wrist.is_none()) wrist_.emplace(wrist, std::initializer_list<int>{4, 4});
    if (!landmarks_.data || (wrist_ && !wrist_->data))
      throw std::invalid_argument("wrong size of landmarks or wrist");
    sample = {time,  landmarks_.data, wrist_ ? wrist_->data : nullptr,
              valid, confidence,      arrival.value_or(kNaN)};
  }

 private:
  Borrowed landmarks_;
  std::optional<Borrowed> wrist_;
};

// A `StreamGuard` for Python.
class PythonGuard : public Exclusive {
 public:
  StreamGuard guard;

  PythonGuard(const GuardModel& model, std::shared_ptr<const LandmarkOrders> orders)
      : guard(sign_of(model.side), landmarks_of(&model.landmarks[0].x), std::move(orders)) {}

  using Saved = std::tuple<nb::bytes, nb::bytes, nb::bytes>;
  Saved save() const {
    return {bytes_of(guard.state), bytes_of(guard.rate), bytes_of(guard.input.state)};
  }
  void restore(const Saved& saved) {
    const auto& [state, rate, input] = saved;
    // Nothing is taken before all of it is right.
    StreamGuard restored = guard;
    restore_state(state, restored.state);
    put_back(rate, restored.rate);
    restore_state(input, restored.input.state);
    guard = std::move(restored);
    former = guard.state;
  }

  Verdict judge(const StreamSample& sample) {
    former = guard.state;
    return guard.check(sample);
  }
  // Forget the sample that was judged last, but not what it said about the input.
  void forget() { guard.state = former; }

  VerdictNumbers check(double time, const nb::object& landmarks, const nb::object& wrist, bool valid,
                       double confidence, std::optional<double> arrival) {
    return numbers_of(
        judge(GivenSample(time, landmarks, wrist, valid, confidence, arrival).sample));
  }

  // Judge a whole recording: which samples are held.
  nb::object holds(const Samples& samples) {
    bool* held = new bool[samples.count];
    const nb::capsule owner(held, [](void* p) noexcept { delete[] static_cast<bool*>(p); });
    {
      const nb::gil_scoped_release no_gil;
      for (size_t t = 0; t < samples.count; ++t) held[t] = guard.check(samples.sample(t)).is_held;
    }
    return nb::cast(nb::ndarray<nb::numpy, bool>(held, {samples.count}, owner));
  }

  GuardState former = guard.state;  // before the sample that was judged last
};

}  // namespace handmap
