// One call a sample, from what Python has to the step that it reads: see mapping/hand_mapper.py, and
// stream/hand_follower.py for samples that a guard judges and a filter smooths first.
#pragma once

#include <nanobind/stl/pair.h>

#include <chrono>

#include "arrays.hpp"
#include "build_guard.hpp"
#include "build_smoothing.hpp"
#include "handmap/run.hpp"

namespace handmap {

// -- samples

// When a command is: an instant with the longest time that it may take, or the time since the last one.
inline When when_from(const nb::object& given) {
  if (nb::isinstance<nb::tuple>(given))
    return When::at(nb::cast<double>(item(given, 0)), nb::cast<double>(item(given, 1)));
  return When::after(nb::cast<double>(given));
}

// The same, or none for what Python has to look at; see command_time.check_when.
inline std::optional<When> plain_when(const nb::object& given) {
  std::pair<double, double> instant;
  if (nb::isinstance<nb::tuple>(given)) {
    // An `Instant` has a type of its own.
    if (given.type().is(nb::handle(reinterpret_cast<PyObject*>(&PyTuple_Type)))) return {};
    if (!nb::try_cast(given, instant)) return {};
    const auto [time, longest] = instant;
    const bool is_right = std::isfinite(time) && longest > 0.0;
    return is_right ? std::optional(When::at(time, longest)) : std::nullopt;
  }
  if (!PyFloat_Check(given.ptr())) return {};
  const double dt = PyFloat_AsDouble(given.ptr());
  return dt > 0.0 && dt < HUGE_VAL ? std::optional(When::after(dt)) : std::nullopt;
}

// Whether Python has nothing to say about numbers: no coordinate is farther than any hand.
inline bool is_plain(const Borrowed& numbers, size_t count) {
  return numbers.data && is_near(numbers.data, count);
}

// A pose whose rotation is one up to rounding.
inline std::optional<Pose> plain_pose(const nb::handle& given) {
  const Borrowed numbers(given, {4, 4});
  return numbers.data ? exact_pose(numbers.data) : std::nullopt;
}

// A sample of landmarks, or none for what Python has to look at.
inline std::optional<HumanPose> read_landmarks(const LandmarkReader* reader,
                                               const nb::handle& landmarks,
                                               const nb::handle& wrist) {
  const Borrowed points(landmarks, {kLandmarks, 3});
  if (!reader || !is_plain(points, 3 * kLandmarks)) return {};
  if (wrist.is_none()) return reader->read(points.data, nullptr);
  const std::optional<Pose> pose = plain_pose(wrist);
  if (!pose) return {};
  return reader->read(points.data, &*pose);
}

// Likewise of joint angles.
inline std::optional<HumanPose> read_joints(JointReader* reader, const nb::handle& q,
                                            const nb::handle& wrist) {
  if (!reader) return {};
  const Borrowed angles(q, {static_cast<int>(reader->size())});
  if (!is_plain(angles, reader->size())) return {};
  const std::optional<Pose> pose = plain_pose(wrist);
  if (!pose || !reader->is_within_limits(angles.data)) return {};
  return reader->read(angles.data, *pose);
}

inline void check_pose(const TargetMap& map, const HumanPose& pose) {
  expect(pose.has_wrist || !map.needs_wrist, "no wrist");
  expect(pose.points.size() == map.human_points, "the map is of another hand");
}

inline void check_robot(const TargetMap& map, const Ik& ik) {
  expect(map.rest.size() == ik.tree.q_indices.size(), "the map is of another robot");
  if (const DistanceTask* task = map.distances()) expect_joints(ik.tree, task->points);
}

// Runs work of the core, without the interpreter's lock where it takes long, so that other threads of
// Python go on meanwhile.
//
// A thread that gives the lock up waits for it afterwards, up to the switch interval of another one
// (`sys.setswitchinterval`, 5 ms if it was not called). So work that usually takes less keeps the
// lock. What it works on must be marked as at work (busy.hpp).
class Unlocked {
 public:
  // `longest` is the time of the last work up to which the next one keeps the lock [s].
  explicit Unlocked(double longest) : longest_(longest) {}

  template <class Call>
  void run(const Call& call) {
    if (took_ >= longest_) {
      const nb::gil_scoped_release no_gil;
      took_ = time_of(call);
    } else {
      took_ = time_of(call);
    }
  }

 private:
  // Run work; return its time, without that of waiting for the lock [s].
  template <class Call>
  static double time_of(const Call& call) {
    using Clock = std::chrono::steady_clock;
    const Clock::time_point started = Clock::now();
    call();
    return std::chrono::duration<double>(Clock::now() - started).count();
  }

  const double longest_;
  double took_ = 0.0;  // by the last work [s]
};

// -- steps

// What makes the objects of Python of a step, when they are asked for; see step.Stages.
struct StepViews {
  nb::callable targets;  // of the arrays of a map, and whether a stretch is clamped
  nb::callable ik;       // of the step
  nb::callable command;  // of joint positions and the wrist
  nb::callable summary;  // of its fields
};

// What Python needs to read the numbers of a step.
struct StepReader {
  StepViews views;
  std::shared_ptr<const TargetMap> map;  // none for a robot of several hands
  Indices columns;                       // see Hand.joint_columns
  // Steps whose objects of Python are gone, and whose memory the next ones take over.
  mutable std::vector<Step> spare{};
  static constexpr size_t kMostSpare = 4;

  void recycle(Step&& step) const {
    if (spare.size() < kMostSpare) spare.push_back(std::move(step));
  }
};

// The arrays of targets: points and wrist; where there are distances, their aims, weights and
// margins; and the diagnostics of the map, if one made them. See CoreMap.targets_of.
inline nb::list arrays_of(const Targets& targets, const TargetMap* map) {
  nb::list found;
  found.append(array_of(targets.points));
  found.append(array_of(targets.wrist));
  if (targets.distances)
    for (const Vector* part : {&targets.aims, &targets.weights, &targets.margins})
      found.append(array_of(*part));
  if (!map) return found;
  const double* from = targets.diagnostics.data();
  for (const auto [rows, columns] : map->shapes()) {
    found.append(columns ? array_of({rows, columns}, from) : array_of({rows}, from));
    from += rows * std::max<size_t>(columns, 1);
  }
  return found;
}

// `Stages` of a step, whose objects Python gets when it asks for them.
struct Stages : Step {
  std::shared_ptr<const StepReader> reader;
  HumanPose pose;
  nb::object targets_, ik_, command_, summary_;

  Stages() = default;
  Stages(const Stages&) = delete;
  ~Stages() {
    if (reader) reader->recycle(std::move(*this));
  }

  // What a user should know of the sample, a word each; see method.Targets.
  nb::tuple flags() const {
    return targets.is_clamped ? nb::make_tuple("stretch_clamped") : nb::tuple();
  }
  nb::object read_targets() {
    if (!targets_.is_valid())
      targets_ =
          reader->views.targets(arrays_of(targets, reader->map.get()), targets.is_clamped);
    return targets_;
  }
  nb::object read_command() {
    if (!command_.is_valid())
      command_ = reader->views.command(array_of(q), array_of(result.wrists[0]));
    return command_;
  }
  // The numbers that a watcher of the robot needs, without the objects that they would come from.
  nb::object read_summary() {
    if (summary_.is_valid()) return summary_;
    nb::list point_error, at_bound;
    for (size_t k = 0; k < result.points.size(); ++k)
      point_error.append(norm(result.targets[k] - result.points[k]));
    for (const int column : reader->columns) at_bound.append(result.active[column] != 0);
    const Pose &wrist = result.wrists[0], &target = targets.wrist;
    const nb::tuple wrist_error = nb::make_tuple(
        norm(wrist.p - target.p), norm(log3(transposed(target.R) * wrist.R)));
    const double residual = reader->map ? reader->map->residual(targets) : 0.0;
    return summary_ = reader->views.summary(point_error, wrist_error, at_bound, residual,
                                            flags());
  }
};

// Stages to be filled, which may have the numbers of an earlier step, and the object of Python that owns
// them.
inline std::pair<nb::object, Stages&> new_stages(std::shared_ptr<const StepReader> reader) {
  nb::object made = nb::inst_alloc(nb::type<Stages>());
  Stages& stages = *new (nb::inst_ptr<Stages>(made)) Stages();
  nb::inst_mark_ready(made);
  if (!reader->spare.empty()) {
    static_cast<Step&>(stages) = std::move(reader->spare.back());
    reader->spare.pop_back();
  }
  stages.reader = std::move(reader);
  return {made, stages};
}

inline nb::object read_ik(const nb::object& self) {
  Stages& stages = nb::cast<Stages&>(self);
  if (!stages.ik_.is_valid()) stages.ik_ = stages.reader->views.ik(self);
  return stages.ik_;
}

// Reads the samples after a reference as they come in, and hands them on; one call each.
class SampleReader {
 public:
  // What was made of a sample, and the time that it took [s].
  using Timed = std::pair<nb::object, double>;
  // The verdict about a sample, and what was made of it, if anything, with its time.
  using Judged = std::tuple<VerdictNumbers, nb::object, double>;

  explicit SampleReader(std::shared_ptr<const TargetMap> map) : map_(std::move(map)) {}
  SampleReader(const SampleReader&) = delete;
  virtual ~SampleReader() = default;

  // The stages for a pose.
  nb::object follow(const HumanPose& pose, const nb::object& when, double speed) {
    return moved(HumanPose(pose), when_from(when), speed);
  }

  // Map a sample as it comes in; none for one that Python has to look at.
  std::optional<Timed> map_joints(JointReader* reader, const nb::object& q, const nb::object& wrist,
                                  const nb::object& when) {
    const Clock::time_point started = Clock::now();
    return timed(read_joints(reader, q, wrist), when, started);
  }
  std::optional<Timed> map_landmarks(const LandmarkReader* reader, const nb::object& landmarks,
                                     const nb::object& wrist, const nb::object& when) {
    const Clock::time_point started = Clock::now();
    return timed(read_landmarks(reader, landmarks, wrist), when, started);
  }

  // Judge a sample of a tracker and map it. Return only the verdict about one that is to be held, or
  // that the follower returns with; or none for one that Python has to judge. `origin` is where the
  // stream's time begins on the robot's clock [s]; none if that is not known.
  std::optional<Judged> map_sample(PythonGuard& guard, PythonSmoother& smoother,
                                   const LandmarkReader& reader, double time,
                                   const nb::object& landmarks, const nb::object& wrist_pose,
                                   bool valid, double confidence, const nb::object& when,
                                   std::optional<double> arrival, std::optional<double> origin) {
    std::optional<When> given;
    if (!when.is_none() && !(given = plain_when(when))) return {};
    if (!given && !origin) return {};
    const GivenSample from(time, landmarks, wrist_pose, valid, confidence, arrival);
    std::optional<Pose> wrist;
    if (from.sample.wrist && !(wrist = exact_pose(from.sample.wrist))) return {};
    if (valid && !is_near(from.sample.landmarks, 3 * kLandmarks)) return {};
    const Work judging(guard), smoothing(smoother);
    const double last = given ? 0.0 : last_time();
    const Verdict verdict = guard.judge(from.sample);
    const Judged alone{numbers_of(verdict), nb::none(), 0.0};
    if (verdict.is_held || verdict.is_return) return alone;
    // Python relates the stream's clock to the robot's.
    const double instant = given ? 0.0 : *origin + verdict.time;
    if (!given && last - instant > kBehind) return alone;
    const Clock::time_point started = Clock::now();
    try {
      const double speed = verdict.rule == kUnproven ? kUnprovenSpeed : 1.0;
      const double granted = given ? given->own_time() : std::max(verdict.dt, kShortestDt);
      HumanPose pose = reader.read(from.sample.landmarks, wrist ? &*wrist : nullptr);
      smoother.smoother.smooth(pose, granted);
      nb::object made =
          moved(std::move(pose), given ? *given : When::at(instant, granted), speed);
      return Judged{numbers_of(verdict), std::move(made), seconds_since(started)};
    } catch (...) {
      guard.forget();
      smoother.smoother.forget();
      throw;
    }
  }

 protected:
  std::shared_ptr<const TargetMap> map_;

  virtual nb::object moved(HumanPose&& pose, const When& when, double speed) = 0;
  // Instant of the robot's last command, on its clock [s].
  virtual double last_time() = 0;

 private:
  using Clock = std::chrono::steady_clock;

  static double seconds_since(Clock::time_point started) {
    return std::chrono::duration<double>(Clock::now() - started).count();
  }

  std::optional<Timed> timed(std::optional<HumanPose>&& pose, const nb::object& given,
                             Clock::time_point started) {
    const std::optional<When> when = plain_when(given);
    if (!pose || !when) return {};
    nb::object made = moved(std::move(*pose), *when, 1.0);
    return Timed{std::move(made), seconds_since(started)};
  }
};

// Maps the samples after a reference to commands of one hand; see mapping/hand_mapper.py.
class HandMapper : public SampleReader {
 public:
  HandMapper(std::shared_ptr<Ik> ik, std::shared_ptr<const TargetMap> map, StepViews views)
      : SampleReader(map), ik_(std::move(ik)),
        reader_(std::make_shared<StepReader>(
            StepReader{std::move(views), std::move(map), ik_->tree.joint_columns})) {
    check_robot(*map_, *ik_);
  }

  // Map samples of a recording, whose time begins at `origin` on the robot's clock; see run.hpp.
  // Return the first that is left out, the verdict about it if it was judged, and the pose that was
  // mapped last, if any.
  std::tuple<size_t, std::optional<VerdictNumbers>, std::optional<HumanPose>> run(
      PythonGuard& guard, PythonSmoother& smoother, const LandmarkReader& reader, double origin,
      const Samples& samples, size_t first, size_t last,
      const nb::ndarray<double, nb::c_contig, nb::device::cpu>& rows) {
    const size_t width = row_width(*ik_);
    if (last > samples.count || rows.ndim() != 2 || rows.shape(0) != samples.count ||
        rows.shape(1) != width)
      throw std::invalid_argument("wrong sizes of samples or rows");
    check_pose(*map_, {std::vector<Vec3>(reader.size()), true, {}});
    const Work moving(*ik_), judging(guard), smoothing(smoother);
    Run run{*ik_, *map_, reader, guard.guard, smoother.smoother, origin};
    size_t next = first;
    std::exception_ptr failure;
    {
      const nb::gil_scoped_release no_gil;
      try {
        while (next < last && run.take(samples.sample(next), rows.data() + next * width)) ++next;
      } catch (...) {
        failure = std::current_exception();
      }
    }
    guard.former = run.former;
    if (failure) std::rethrow_exception(failure);
    std::optional<VerdictNumbers> verdict;
    if (run.leaves) verdict = numbers_of(run.verdict);
    std::optional<HumanPose> seen;
    if (run.has_seen) seen = std::move(run.seen);
    return {next, std::move(verdict), std::move(seen)};
  }

 protected:
  nb::object moved(HumanPose&& pose, const When& when, double speed) override {
    check_pose(*map_, pose);
    const Work moving(*ik_);
    auto [made, stages] = new_stages(reader_);
    stages.pose = std::move(pose);
    unlocked_.run(
        [&, &to = stages] { handmap::follow(*ik_, *map_, to.pose, when, speed, goal_, to); });
    return made;
  }
  double last_time() override {
    const Work reading(*ik_);
    return ik_->motion.time;
  }

 private:
  std::shared_ptr<Ik> ik_;
  std::shared_ptr<const StepReader> reader_;
  Goal goal_;
  Unlocked unlocked_{3e-4};
};

// A mapper of Python that is copied makes its own: None takes the place of this one.
template <class T>
nb::tuple without_copy(const T&) {
  return nb::make_tuple(nb::none().type(), nb::tuple());
}

}  // namespace handmap
