// The guard and the input check for Python: their samples, verdicts and findings.
#pragma once

#include <nanobind/stl/optional.h>

#include <cstring>
#include <optional>

#include "arrays.hpp"
#include "guard.hpp"

namespace handmap {

using Flags = nb::ndarray<const bool, nb::c_contig, nb::device::cpu>;

inline double sign_of(const std::string& side) { return side == "right" ? 1.0 : -1.0; }

inline Landmarks landmarks_from(const Array& points) {
  expect_size(points, 3 * kLandmarks, "landmarks");
  return landmarks_of(points.data());
}

// Orders in which landmarks may come, by name; our own comes first.
struct NamedOrders {
  std::shared_ptr<const LandmarkOrders> orders;
  std::vector<nb::object> names;

  NamedOrders(const std::vector<std::string>& own_names, const std::vector<Indices>& indices) {
    expect(own_names.size() == indices.size() && !indices.empty(), "a name for each order");
    std::vector<std::array<int, kLandmarks>> known;
    for (const Indices& each : indices) {
      expect(each.size() == kLandmarks, "wrong size of an order");
      expect_indices(each, kLandmarks, "orders");
      std::copy(each.begin(), each.end(), known.emplace_back().begin());
    }
    orders = std::make_shared<const LandmarkOrders>(std::move(known));
    for (const std::string& name : own_names) names.push_back(nb::str(name.c_str()));
  }
};

// Makes findings and verdicts of Python.
class Namer {
 public:
  Namer(const std::string& side, std::shared_ptr<const NamedOrders> orders)
      : orders_(std::move(orders)), side_(nb::str(side.c_str())) {
    const Fields sample = module_of("human.sample");
    verdict_ = sample.object("Verdict");
    finding_ = sample.object("Finding");
    new_tuple_ = nb::module_::import_("builtins").attr("tuple").attr("__new__");
    for (const char* name : kRuleNames) rules_.push_back(nb::str(name));
    for (const MistakeName& each : kMistakes) mistakes_.push_back(nb::str(each.name));
  }

  nb::object side() const { return side_; }

  nb::object finding_of(const Finding& finding) const {
    if (finding.is_none()) return nb::none();
    const bool is_order = finding.mistake == Mistake::order;
    return new_tuple_(finding_,
                      nb::make_tuple(rules_[finding.rule()],
                                     mistakes_[static_cast<int>(finding.mistake)], side_,
                                     finding.number, finding.which,
                                     is_order ? orders_->names.at(finding.which) : rules_[0]));
  }

  nb::object verdict_of(const Verdict& verdict) const {
    return new_tuple_(verdict_,
                      nb::make_tuple(rules_[verdict.rule], verdict.is_held, verdict.is_return,
                                     verdict.dt, verdict.consistency, finding_of(verdict.finding),
                                     verdict.lost, verdict.time));
  }

 private:
  std::shared_ptr<const NamedOrders> orders_;
  nb::object side_, verdict_, finding_, new_tuple_;
  std::vector<nb::object> rules_, mistakes_;
};

// State as bytes, to be put back in a process that has the same core.
template <class State>
nb::bytes bytes_of(const State& state) {
  static_assert(std::is_trivially_copyable_v<State>);
  return nb::bytes(reinterpret_cast<const char*>(&state), sizeof(State));
}
template <class State>
void put_back(const nb::object& bytes, State& state) {
  const nb::bytes given = nb::cast<nb::bytes>(bytes);
  if (given.size() != sizeof(State)) throw std::invalid_argument("a state of another core");
  std::memcpy(static_cast<void*>(&state), given.c_str(), sizeof(State));
}

// The same of a state that says whether it can be one.
template <class State>
void restore_state(const nb::object& bytes, State& state) {
  State restored{};
  put_back(bytes, restored);
  expect(restored.is_sound(), "a damaged state");
  state = restored;
}

// The columns of a `Recording`, with or without the wrist's poses.
class Samples {
 public:
  size_t count;
  const double *time, *landmarks, *confidence, *wrists = nullptr;
  const bool* valid;

  Samples(const nb::object& recording, bool has_wrists) : from_(recording) {
    count = from_.get<Array>("time").size();
    time = column("time", count);
    landmarks = column("landmarks", 3 * kLandmarks * count);
    expect(landmarks != nullptr || count == 0, "samples without landmarks");
    confidence = column("confidence", count);
    if (has_wrists) wrists = column("wrist", 16 * count);
    flags_ = from_.get<Flags>("valid");
    if (flags_.size() != count) throw std::invalid_argument("wrong size of valid");
    valid = flags_.data();
  }
  const double* landmarks_at(size_t t) const { return landmarks + 3 * kLandmarks * t; }
  const double* wrist_at(size_t t) const { return wrists ? wrists + 16 * t : nullptr; }
  StreamSample sample(size_t t) const {
    return {time[t], landmarks_at(t), wrist_at(t), valid[t], confidence ? confidence[t] : 1.0,
            std::numeric_limits<double>::quiet_NaN()};
  }

 private:
  Fields from_;
  std::vector<Array> kept_;
  Flags flags_;

  const double* column(const char* name, size_t size) {
    if (from_.object(name).is_none()) return nullptr;
    kept_.push_back(from_.array(name, size));
    return kept_.back().data();
  }
};

// An `InputCheck` for Python.
class PythonInputCheck : public Exclusive {
 public:
  PythonInputCheck(const std::string& side, const std::shared_ptr<const NamedOrders>& orders)
      : namer_(side, orders), check_(sign_of(side), orders->orders) {}

  nb::bytes save() const { return bytes_of(check_.state); }
  void restore(const nb::object& saved) { restore_state(saved, check_.state); }

  nb::object update(double time, const Array& landmarks, const std::optional<Array>& wrist) {
    if (wrist) expect_size(*wrist, 16, "wrist");
    return namer_.finding_of(
        take(time, landmarks_from(landmarks), wrist ? wrist->data() : nullptr));
  }

  // Take a whole `Recording`; what is wrong in a quarter of its valid samples or more.
  nb::object examine(const nb::object& recording) {
    const Samples samples(recording, true);
    Finding finding;
    {
      const nb::gil_scoped_release no_gil;
      finding = examined(samples);
    }
    return namer_.finding_of(finding);
  }

  nb::object finish() { return namer_.finding_of(check_.finish()); }
  nb::object finding() const { return namer_.finding_of(check_.state.finding); }
  bool is_wrist_proven() const { return check_.state.seen.wrist.is_proven; }
  void alert() { check_.alert(); }

 private:
  Namer namer_;
  InputCheck check_;

  const Finding& take(double time, const Landmarks& landmarks, const double* wrist) {
    Pose pose;
    if (wrist) pose = pose_of(wrist);
    return check_.update(time, landmarks, wrist ? &pose : nullptr);
  }

  Finding examined(const Samples& samples) {
    std::vector<size_t> seen;
    for (size_t t = 0; t < samples.count; ++t)
      if (samples.valid[t]) seen.push_back(t);
    if (seen.empty()) return {};
    size_t found = 0;
    for (const size_t t : seen) {
      const Finding& finding =
          take(samples.time[t], landmarks_of(samples.landmarks_at(t)), samples.wrist_at(t));
      if (finding.is_none()) continue;
      ++found;
      const bool is_much = found >= kRefusedShare * seen.size();
      if (is_much || finding.rule() == kTime) return finding;
    }
    const Finding last = check_.finish();
    const double duration = samples.time[seen.back()] - samples.time[seen.front()];
    return duration <= kShortRecording ? last : Finding{};
  }
};

// A `StreamGuard` for Python.
class PythonGuard : public Exclusive {
 public:
  StreamGuard guard;

  // Of the landmarks of the person's hand at rest.
  PythonGuard(const std::string& side, const Array& person,
              const std::shared_ptr<const NamedOrders>& orders)
      : guard(sign_of(side), landmarks_from(person), orders->orders), namer_(side, orders) {
    for (const char* name : {"time", "landmarks", "wrist", "valid", "confidence", "side"})
      names_.push_back(nb::steal(PyUnicode_InternFromString(name)));
  }

  nb::tuple save() const {
    return nb::make_tuple(bytes_of(guard.state), bytes_of(guard.rate),
                          bytes_of(guard.input.state));
  }
  void restore(const nb::object& saved) {
    restore_state(item(saved, 0), guard.state);
    put_back(item(saved, 1), guard.rate);
    restore_state(item(saved, 2), guard.input.state);
    former = guard.state;
  }

  // A `HumanSample` of Python, whose arrays it keeps.
  struct Given {
    Borrowed landmarks;
    std::optional<Borrowed> wrist;
    StreamSample sample;

    Given(const PythonGuard& guard, const nb::object& from, const nb::object& arrival)
        : landmarks(guard.field(from, 1), {kLandmarks, 3}) {
      const nb::object pose = guard.field(from, 2);
      if (!pose.is_none()) wrist.emplace(pose, std::initializer_list<int>{4, 4});
      if (!landmarks.data || (wrist && !wrist->data))
        throw std::invalid_argument("wrong size of landmarks or wrist");
      const double now = arrival.is_none() ? kNaN : nb::cast<double>(arrival);
      const int is_valid = PyObject_IsTrue(guard.field(from, 3).ptr());
      if (is_valid < 0) nb::raise_python_error();
      sample = {nb::cast<double>(guard.field(from, 0)), landmarks.data,
                wrist ? wrist->data : nullptr, is_valid != 0,
                nb::cast<double>(guard.field(from, 4)), now};
    }
  };

  // Whether something is a sample of the guard's own hand.
  bool is_own(const nb::object& sample) const {
    const nb::object side = nb::getattr(sample, names_[5], nb::none());
    return side.is(namer_.side()) || side.equal(namer_.side());
  }

  Verdict judge_one(const StreamSample& sample) {
    former = guard.state;
    return guard.check(sample);
  }
  // Forget the sample that was judged last, but not what it said about the input.
  void forget() { guard.state = former; }

  nb::object check(const nb::object& sample, const nb::object& arrival) {
    return verdict_of(judge_one(Given(*this, sample, arrival).sample));
  }

  // Judge a whole `Recording` without its wrist: which samples are held.
  nb::object holds(const nb::object& recording) {
    const Samples samples(recording, false);
    bool* held = new bool[samples.count];
    const nb::capsule owner(held, [](void* p) noexcept { delete[] static_cast<bool*>(p); });
    {
      const nb::gil_scoped_release no_gil;
      for (size_t t = 0; t < samples.count; ++t) held[t] = guard.check(samples.sample(t)).is_held;
    }
    return nb::cast(nb::ndarray<nb::numpy, bool>(held, {samples.count}, owner));
  }

  nb::object verdict_of(const Verdict& verdict) const { return namer_.verdict_of(verdict); }

  GuardState former = guard.state;  // before the sample that was judged last

 private:
  Namer namer_;
  std::vector<nb::object> names_;

  nb::object field(const nb::object& sample, int i) const {
    return nb::getattr(sample, names_[i]);
  }
};

}  // namespace handmap
