// The guard of Python: its numbers, its samples and verdicts, and what it says in words.
#pragma once

#include <nanobind/stl/optional.h>

#include <cstring>
#include <map>
#include <optional>

#include "arrays.hpp"
#include "guard.hpp"

namespace handmap {

using Flags = nb::ndarray<const bool, nb::c_contig, nb::device::cpu>;

inline void copy_numbers(const Fields& from, const std::string& path, double* to, size_t size) {
  const nb::object list = from.object(path).attr("__iter__")();
  size_t i = 0;
  for (const nb::handle each : list) {
    if (i == size) break;
    to[i++] = nb::cast<double>(nb::borrow(each));
  }
  if (i != size) throw std::invalid_argument("wrong size of " + path);
}

struct NamedNumber {
  const char* name;
  double* to;
};
inline void read_numbers(const Fields& from, std::initializer_list<NamedNumber> numbers) {
  for (const NamedNumber& each : numbers) *each.to = from.get<double>(each.name);
}

inline BatchSize batch_size(const Fields& from, const std::string& path) {
  BatchSize size{from.get<int>(path + ".most"), from.get<int>(path + ".least"),
                 from.get<double>(path + ".time")};
  if (size.most > kMostSamples) throw std::invalid_argument("too many samples of a batch");
  return size;
}

inline void read_orders(InputRules& rules, const Indices& pairs, const Indices& orders) {
  std::map<std::pair<int, int>, int> known;
  const auto place_of = [&](int a, int b) {
    const auto key = std::minmax(a, b);
    const auto [at, is_new] = known.try_emplace(key, static_cast<int>(rules.first.size()));
    if (is_new) {
      rules.first.push_back(a);
      rules.second.push_back(b);
    }
    return at->second;
  };
  if (pairs.size() != 2 * kPairs) throw std::invalid_argument("wrong size of pairs");
  for (int i = 0; i < kPairs; ++i) place_of(pairs[2 * i], pairs[2 * i + 1]);
  // The first order is our own.
  rules.orders = static_cast<int>(orders.size()) / kLandmarks - 1;
  for (int i = 0; i < kPairs; ++i)
    for (int k = 1; k <= rules.orders; ++k) {
      const int* order = orders.data() + k * kLandmarks;
      rules.places.push_back(place_of(order[pairs[2 * i]], order[pairs[2 * i + 1]]));
    }
}

inline Indices integers_of(const nb::object& array) {
  return nb::cast<Indices>(array.attr("ravel")().attr("tolist")());
}

inline std::unique_ptr<InputRules> read_input_rules() {
  auto found = std::make_unique<InputRules>();
  InputRules& rules = *found;
  const Fields check = module_of("trackers.plausibility");
  rules.fresh = batch_size(check, "_NEW");
  rules.calm = batch_size(check, "_CALM");
  rules.alert = batch_size(check, "_ALERT");
  rules.calm_batches = check.get<int>("_CALM_BATCHES");
  rules.carried_batches = check.get<int>("_CARRIED_BATCHES");
  rules.first_sizes = check.get<int>("_FIRST_SIZES");
  if (rules.carried_batches >= kMostPast || rules.first_sizes > kMostSizes)
    throw std::invalid_argument("too many batches");
  read_numbers(check, {{"_SURE_SIDE", &rules.sure_side}, {"_BACKWARDS", &rules.backwards},
                       {"_OTHERWISE_RIGHT", &rules.otherwise_right},
                       {"_SAME_MISFIT", &rules.same_misfit}, {"_RESIZED", &rules.resized},
                       {"_REFUSED_SHARE", &rules.refused_share}, {"_SHORT", &rules.brief}});
  double range[2];
  copy_numbers(check, "_STEPS", range, 2);
  rules.shortest_step = range[0];
  rules.longest_step = range[1];
  copy_numbers(check, "HAND_LENGTHS", range, 2);
  rules.shortest_hand = range[0];
  rules.longest_hand = range[1];
  read_numbers(check, {{"_NO_HAND", &rules.no_hand}, {"_BETTER_BY", &rules.better_by},
                       {"_CONTRADICTION", &rules.contradiction}});
  const Fields hand = module_of("trackers.hand_geometry");
  copy_numbers(hand, "_CENTRES", rules.centres, kPairs);
  copy_numbers(hand, "_WIDTHS", rules.widths, kPairs);
  const Vector sizes = hand.numbers("_FEATURE_SIZES");
  if (sizes.size() != 5) throw std::invalid_argument("wrong size of _FEATURE_SIZES");
  std::copy(sizes.begin(), sizes.end(), rules.feature_sizes);
  read_numbers(hand, {{"_LARGEST_DEVIATION", &rules.largest_deviation},
                      {"_RIGID_SPREAD", &rules.rigid_spread},
                      {"_QUARTILES_APART", &rules.quartiles_apart}});
  copy_numbers(hand, "HYPEREXTENSION", range, 2);
  rules.hyperextension = range[0];
  read_numbers(hand, {{"_LEAST_TREMBLING", &rules.least_trembling}, {"_STUCK", &rules.stuck},
                      {"_CARRIED", &rules.carried}, {"_STEP", &rules.step},
                      {"_OTHERS_CHANGE", &rules.others_change}});
  copy_numbers(hand, "_INSIDE", range, 2);
  rules.most_bent = range[0];
  rules.least_bent = range[1];
  const nb::object orders = item(check.object("_known_orders")(), 1);
  read_orders(rules, integers_of(hand.object("_PAIRS")), integers_of(orders));
  const Fields wrist = module_of("trackers.wrist_axes");
  const Array conventions = wrist.get<Array>("CONVENTIONS");
  for (size_t k = 0; k < conventions.shape(0); ++k) {
    Mat3 axes;
    std::copy(conventions.data() + 9 * k, conventions.data() + 9 * k + 9, axes.m);
    rules.conventions.push_back(axes);
  }
  read_numbers(wrist, {{"_FARTHEST", &rules.farthest}, {"_STEADY", &rules.steady},
                       {"_TURNED", &rules.turned}, {"_KEPT", &rules.kept},
                       {"_FARTHEST_APART", &rules.farthest_apart}});
  return found;
}

inline NoiseRules read_noise_rules() {
  NoiseRules rules;
  read_numbers(module_of("trackers.hand_geometry"),
               {{"_NORMAL", &rules.normal}, {"_SHARE", &rules.share}, {"_MOST", &rules.most},
                {"_LEAST", &rules.least}});
  return rules;
}

inline std::unique_ptr<GuardRules> read_guard_rules() {
  auto found = std::make_unique<GuardRules>();
  GuardRules& rules = *found;
  const Fields from = module_of("stream.guard");
  read_numbers(from, {{"LONGEST_STEP", &rules.longest_step}, {"GAP", &rules.gap},
                      {"BEHIND", &rules.behind}, {"_SET_BACK", &rules.set_back},
                      {"_SET_FORWARD", &rules.set_forward}});
  rules.late_samples = from.get<int>("_LATE_SAMPLES");
  read_numbers(from, {{"_PERIOD_SHARE", &rules.period_share},
                      {"_SHORTEST_STEP", &rules.shortest_step},
                      {"_RATE_WINDOW", &rules.rate_window},
                      {"_LARGEST_DRIFT", &rules.largest_drift},
                      {"_CREDIT_RATE", &rules.credit_rate}});
  const Indices starts = from.indices("_STARTS"), ends = from.indices("_ENDS");
  if (starts.size() != kFixed || ends.size() != kFixed)
    throw std::invalid_argument("wrong size of _STARTS");
  std::copy(starts.begin(), starts.end(), rules.starts);
  std::copy(ends.begin(), ends.end(), rules.ends);
  read_numbers(from, {{"ZERO_SIZE", &rules.zero_size}, {"MIRROR", &rules.mirror},
                      {"ALONE", &rules.alone}, {"FIRST_NOISE", &rules.first_noise}});
  copy_numbers(from, "BELIEVED", rules.believed, kSizes);
  copy_numbers(from, "NOISY", rules.noisy, kSizes);
  rules.noise = read_noise_rules();
  read_numbers(from, {{"FROZEN_AFTER", &rules.frozen_after}, {"SETTLING", &rules.settling},
                      {"_LONG_SETTLING", &rules.long_settling}, {"_BRIEF", &rules.brief}});
  copy_numbers(module_of("human.sample"), "_PALM_RATIOS", rules.palm_ratios, 2);
  return found;
}

// Read once. Another thread may come in while Python runs, so no static of its own would do.
template <class Rules>
const Rules& once(std::unique_ptr<Rules> (*read)()) {
  static Rules* known = nullptr;
  if (!known) {
    std::unique_ptr<Rules> found = read();
    if (!known) known = found.release();
  }
  return *known;
}

// Examines batches by an `InputCheck` of Python, which gets the state of before and gives that after.
class PythonExplainer : public Explainer {
 public:
  nb::object check;
  std::vector<nb::object> findings;

  explicit PythonExplainer(nb::object own_check) : check(std::move(own_check)) {}

  nb::object finding(int number) const {
    return number == kNone ? nb::none() : findings.at(number);
  }

  int add(nb::object found) {
    if (found.is_none()) return kNone;
    const std::string kind = nb::cast<std::string>(found.attr("kind"));
    const auto at = std::find(std::begin(kRuleNames), std::end(kRuleNames), kind);
    if (at == std::end(kRuleNames)) throw std::invalid_argument("no rule " + kind);
    kinds_.push_back(static_cast<int>(at - std::begin(kRuleNames)));
    findings.push_back(std::move(found));
    return static_cast<int>(findings.size()) - 1;
  }

  nb::list save() const {
    nb::list all;
    for (const nb::object& each : findings) all.append(each);
    return all;
  }
  void put_back(const nb::object& all) {
    for (const nb::handle each : all) add(nb::borrow(each));
  }

  // Forget all findings but some, whose numbers change.
  void keep(std::initializer_list<int*> numbers) {
    std::vector<nb::object> kept;
    for (const int* number : numbers) kept.push_back(finding(*number));
    findings.clear();
    kinds_.clear();
    size_t i = 0;
    for (int* number : numbers) *number = add(kept[i++]);
  }

  int rule_of(int number) const override { return kinds_.at(number); }

  int explain_times(const double* times, int n) override {
    const nb::gil_scoped_acquire gil;
    const Fields module = module_of("trackers.plausibility");
    return add(module.object("_find_time_unit")(array_of({size_t(n)}, times)));
  }

  int explain_rate(double rate) override {
    const nb::gil_scoped_acquire gil;
    return add(module_of("stream.guard").object("_off_rate")(rate));
  }

  int explain_batch(const Landmarks* hands, const Pose* wrists, int n, Examined& seen) override {
    const nb::gil_scoped_acquire gil;
    give(seen);
    nb::object poses = nb::none();
    if (wrists) {
      Vector rows;
      for (int t = 0; t < n; ++t)
        for (int i = 0; i < 3; ++i)
          rows.insert(rows.end(), {wrists[t].R(i, 0), wrists[t].R(i, 1), wrists[t].R(i, 2),
                                   wrists[t].p[i]});
      poses = array_of({size_t(n), 3, 4}, rows.data());
    }
    const int number = add(check.attr("_examine")(array_of_hands(hands, n), poses));
    take(seen);
    return number;
  }

 private:
  std::vector<int> kinds_;

  static nb::object array_of_hands(const Landmarks* hands, int n) {
    return array_of({size_t(n), kLandmarks, 3}, &hands[0][0].x);
  }

  void give(const Examined& seen) const {
    check.attr("_misfit") = seen.misfit;
    check.attr("_has_curled") = seen.has_curled;
    nb::list sizes, past;
    for (int i = 0; i < seen.size_count; ++i) sizes.append(seen.sizes[i]);
    for (int b = 0; b < seen.past_count; ++b) {
      const int at = (seen.past_first + b) % kMostPast;
      past.append(array_of_hands(seen.past[at], seen.past_sizes[at]));
    }
    check.attr("_sizes") = sizes;
    check.attr("_past") = past;
    const nb::object wrist = check.attr("_wrist");
    wrist.attr("is_proven") = seen.is_proven;
    wrist.attr("_start") = nb::none();
    if (seen.has_start)
      wrist.attr("_start") = nb::make_tuple(array_of({3, 3}, seen.start_palm.m),
                                            array_of({3, 3}, seen.start_mean.m));
  }

  void take(Examined& seen) const {
    const Fields from(check);
    seen.misfit = from.get<double>("_misfit");
    seen.has_curled = from.get<bool>("_has_curled");
    seen.size_count = 0;
    for (const double size : from.get<std::vector<double>>("_sizes")) {
      if (seen.size_count == kMostSizes) throw std::invalid_argument("too many sizes");
      seen.sizes[seen.size_count++] = size;
    }
    seen.past_count = seen.past_first = 0;
    for (const nb::handle each : from.object("_past")) {
      const Array hands = nb::cast<Array>(nb::borrow(each));
      const size_t samples = hands.size() / (3 * kLandmarks);
      if (seen.past_count == kMostPast || samples > kMostSamples)
        throw std::invalid_argument("too many batches");
      const int at = seen.past_count++, n = static_cast<int>(samples);
      seen.past_sizes[at] = n;
      for (int t = 0; t < n; ++t) seen.past[at][t] = landmarks_of(hands.data() + 3 * kLandmarks * t);
    }
    seen.is_proven = from.get<bool>("_wrist.is_proven");
    const nb::object start = from.object("_wrist._start");
    seen.has_start = !start.is_none();
    if (!seen.has_start) return;
    const Fields palm(item(start, 0)), mean(item(start, 1));
    seen.start_palm = palm.matrix("");
    seen.start_mean = mean.matrix("");
  }
};

inline nb::tuple rule_names() {
  nb::list names;
  for (const char* name : kRuleNames) names.append(name);
  return nb::tuple(names);
}

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

inline nb::object input_check_of(const std::string& side) {
  return module_of("trackers.plausibility").object("InputCheck")(side);
}
inline double sign_of(const std::string& side) { return side == "right" ? 1.0 : -1.0; }

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
  explicit PythonInputCheck(const nb::object& owner)
      : side_(nb::cast<std::string>(owner.attr("side"))), explainer_(input_check_of(side_)),
        check_(once(&read_input_rules), sign_of(side_), explainer_) {
    const nb::object saved = owner.attr("_saved");
    if (saved.is_none()) return;
    put_back(item(saved, 0), check_.state);
    explainer_.put_back(item(saved, 1));
  }

  nb::tuple save() const {
    return nb::make_tuple(bytes_of(check_.state), explainer_.save());
  }

  nb::object update(double time, const Array& landmarks, const std::optional<Array>& wrist) {
    expect_size(landmarks, 3 * kLandmarks, "landmarks");
    if (wrist) expect_size(*wrist, 16, "wrist");
    tidy();
    return explainer_.finding(take(time, landmarks.data(), wrist ? wrist->data() : nullptr));
  }

  // Take a whole `Recording`.
  nb::object examine(const nb::object& recording) {
    const Samples samples(recording, true);
    int finding = kNone;
    {
      const nb::gil_scoped_release no_gil;
      finding = examined(samples);
    }
    return explainer_.finding(finding);
  }

  nb::object finish() { return explainer_.finding(check_.finish()); }
  nb::object finding() const { return explainer_.finding(check_.state.finding); }
  bool is_wrist_proven() const { return check_.state.seen.is_proven; }
  void alert() { check_.alert(); }

 private:
  std::string side_;
  PythonExplainer explainer_;
  InputCheck check_;

  int take(double time, const double* landmarks, const double* wrist) {
    Pose pose;
    if (wrist) pose = pose_of(wrist);
    return check_.update(time, landmarks_of(landmarks), wrist ? &pose : nullptr);
  }

  int examined(const Samples& samples) {
    std::vector<size_t> seen;
    for (size_t t = 0; t < samples.count; ++t)
      if (samples.valid[t]) seen.push_back(t);
    if (seen.empty()) return kNone;
    size_t found = 0;
    for (const size_t t : seen) {
      const int finding = take(samples.time[t], samples.landmarks_at(t), samples.wrist_at(t));
      if (finding == kNone) continue;
      ++found;
      const bool is_much = found >= check_.rules.refused_share * seen.size();
      if (is_much || explainer_.rule_of(finding) == kTime) return finding;
    }
    const int last = check_.finish();
    const double duration = samples.time[seen.back()] - samples.time[seen.front()];
    return duration <= check_.rules.brief ? last : kNone;
  }

  void tidy() {
    if (explainer_.findings.size() > 64)
      explainer_.keep({&check_.state.guess, &check_.state.finding});
  }
};

// A `StreamGuard` for Python.
class PythonGuard : public Exclusive {
 public:
  PythonExplainer explainer;
  StreamGuard guard;

  explicit PythonGuard(const nb::object& owner)
      : explainer(owner.attr("_input")),
        guard(once(&read_guard_rules), once(&read_input_rules),
              sign_of(nb::cast<std::string>(owner.attr("_side"))), explainer) {
    const Fields from(owner);
    side_ = from.object("_side");
    guard.palm = from.get<double>("_palm._size");
    const Array person = from.array("_lengths", kFixed);
    std::copy(person.data(), person.data() + kFixed, guard.person.begin());
    guard.state.noise = guard.rules.first_noise;
    const Fields sample = module_of("human.sample");
    verdict_ = sample.object("Verdict");
    new_tuple_ = nb::module_::import_("builtins").attr("tuple").attr("__new__");
    for (const char* name : kRuleNames) rules_.push_back(nb::str(name));
    for (const char* name : {"time", "landmarks", "wrist", "valid", "confidence", "side"})
      names_.push_back(nb::steal(PyUnicode_InternFromString(name)));
    const nb::object saved = from.object("_saved");
    former = guard.state;
    if (saved.is_none()) return;
    put_back(item(saved, 0), guard.state);
    former = guard.state;
    put_back(item(saved, 1), guard.rate);
    put_back(item(saved, 2), guard.input.state);
    explainer.put_back(item(saved, 3));
  }

  nb::tuple save() const {
    return nb::make_tuple(bytes_of(guard.state), bytes_of(guard.rate), bytes_of(guard.input.state),
                          explainer.save());
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
      const double now = arrival.is_none() ? std::numeric_limits<double>::quiet_NaN()
                                           : nb::cast<double>(arrival);
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
    return side.is(side_) || side.equal(side_);
  }

  Verdict judge_one(const StreamSample& sample) {
    tidy();
    former = guard.state;
    return guard.check(sample);
  }
  // Forget the sample that was judged last.
  void forget() { guard.state = former; }

  nb::object check(const nb::object& sample, const nb::object& arrival) {
    return verdict_of(judge_one(Given(*this, sample, arrival).sample));
  }

  // Judge a whole `Recording` without its wrist: which samples are held.
  nb::object holds(const nb::object& recording) {
    return column<bool>(judged(recording), [](const Verdict& v) { return v.is_held; });
  }

  // Columns of its verdicts, in the order of their fields.
  nb::tuple judge(const nb::object& recording) {
    const std::vector<Verdict> verdicts = judged(recording);
    nb::list findings;
    for (const Verdict& each : verdicts) findings.append(explainer.finding(each.finding));
    return nb::make_tuple(column<int>(verdicts, [](const Verdict& v) { return v.rule; }),
                          column<bool>(verdicts, [](const Verdict& v) { return v.is_held; }),
                          column<bool>(verdicts, [](const Verdict& v) { return v.is_return; }),
                          column<double>(verdicts, [](const Verdict& v) { return v.dt; }),
                          column<double>(verdicts, [](const Verdict& v) { return v.consistency; }),
                          findings);
  }

  nb::object verdict_of(const Verdict& verdict) const {
    const nb::tuple fields =
        nb::make_tuple(rules_[verdict.rule], verdict.is_held, verdict.is_return, verdict.dt,
                       verdict.consistency, explainer.finding(verdict.finding), verdict.lost,
                       verdict.time);
    return new_tuple_(verdict_, fields);
  }

  GuardState former = guard.state;  // before the sample that was judged last

 private:
  nb::object verdict_, new_tuple_, side_;
  std::vector<nb::object> rules_, names_;

  std::vector<Verdict> judged(const nb::object& recording) {
    tidy();
    const Samples samples(recording, false);
    std::vector<Verdict> verdicts(samples.count);
    const nb::gil_scoped_release no_gil;
    for (size_t t = 0; t < samples.count; ++t) verdicts[t] = guard.check(samples.sample(t));
    return verdicts;
  }

  nb::object field(const nb::object& sample, int i) const {
    return nb::getattr(sample, names_[i]);
  }

  template <class T, class Of>
  static nb::object column(const std::vector<Verdict>& verdicts, const Of& of) {
    T* to = new T[verdicts.size()];
    for (size_t t = 0; t < verdicts.size(); ++t) to[t] = of(verdicts[t]);
    nb::capsule owner(to, [](void* p) noexcept { delete[] static_cast<T*>(p); });
    return nb::cast(nb::ndarray<nb::numpy, T>(to, {verdicts.size()}, owner));
  }

  void tidy() {
    InputState& input = guard.input.state;
    if (explainer.findings.size() > 64)
      explainer.keep({&input.guess, &input.finding, &guard.rate.finding});
  }
};

}  // namespace handmap
