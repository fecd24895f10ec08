// One call a sample, from what Python has to the step that it reads: see mapping/mapper.py, and
// stream/follower.py for samples that a guard judges and a filter smooths first.
#pragma once

#include <chrono>

#include "arrays.hpp"
#include "build_guard.hpp"
#include "build_smoothing.hpp"
#include "run.hpp"

namespace handmap {

// -- samples

// A float that Python takes for a time between samples; see mapper.check_dt.
inline std::optional<double> plain_dt(const nb::handle& given) {
  if (!PyFloat_Check(given.ptr())) return {};
  const double dt = PyFloat_AsDouble(given.ptr());
  return dt > 0.0 && dt < HUGE_VAL ? std::optional(dt) : std::nullopt;
}

// When a command is, as a `When` of Python says it.
inline When when_from(const nb::object& given) {
  if (nb::isinstance<nb::tuple>(given))
    return When::at(nb::cast<double>(item(given, 0)), nb::cast<double>(item(given, 1)));
  return When::after(nb::cast<double>(given));
}

// Likewise of a caller of the package, or none for one that Python has to look at; see
// mapper.check_when.
inline std::optional<When> plain_when(const nb::object& given) {
  static const nb::object& instant = *new nb::object(module_of("ik.motion").object("Instant"));
  if (given.type().is(instant)) {
    double time, longest;
    if (!nb::try_cast(item(given, 0), time) || !nb::try_cast(item(given, 1), longest)) return {};
    const bool is_right = std::isfinite(time) && longest > 0.0;
    return is_right ? std::optional(When::at(time, longest)) : std::nullopt;
  }
  const std::optional<double> dt = plain_dt(given);
  return dt ? std::optional(When::after(*dt)) : std::nullopt;
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
  HumanPose found;
  if (!pose || !reader->read(angles.data, *pose, found)) return {};
  return found;
}

inline void check_map(const Ik& ik, const TargetMap& map, const HumanPose& pose) {
  if (map.needs_wrist && !pose.has_wrist) throw std::invalid_argument("no wrist");
  if (pose.points.size() != map.human_points || map.rest.size() != ik.tree.q_indices.size())
    throw std::invalid_argument("the map is of other hands");
}

// -- steps

// Points and wrist; where there are distances, their aims, weights and margins; and diagnostics.
inline nb::list parts_of(const Asked& asked, const std::vector<ArrayShape>& shapes) {
  nb::list found;
  found.append(array_of(asked.points));
  found.append(array_of(asked.wrist));
  if (asked.distances)
    for (const Vector* part : {&asked.aims, &asked.weights, &asked.margins})
      found.append(array_of(*part));
  const double* from = asked.diagnostics.data();
  for (const auto [rows, columns] : shapes) {
    found.append(columns ? array_of({rows, columns}, from) : array_of({rows}, from));
    from += rows * std::max<size_t>(columns, 1);
  }
  return found;
}

// `IkResult` of a step of a hand, with the links of each pair that its gate keeps apart.
inline nb::object result_of(const Step& step, const nb::object& hand, const nb::object& links) {
  static const nb::object& frozen = *new nb::object(module_of("se3").object("frozen"));
  static const nb::object& IkResult =
      *new nb::object(module_of("ik.qp").object("IkResult"));
  static const nb::object& statuses =
      *new nb::object(module_of("ik.compiled").object("STATUSES"));
  const Result& found = step.result;
  const Vector signs(found.active.begin(), found.active.end());
  return IkResult(item(statuses, static_cast<size_t>(found.status)), array_of(found.points),
                  array_of(found.targets), array_of(step.motion.q), array_of(found.wrists),
                  frozen(array_of(found.displacement)),
                  frozen(array_of(signs).attr("astype")("int8")), hand, found.iterations,
                  found.last_step, links[nb::int_(found.held_by)]);
}

// What Python needs to read the numbers of a step.
struct StepReader {
  nb::object hand, links;     // see `result_of`
  nb::object targets;         // makes `Targets` of arrays; None for points and wrist alone
  nb::object joint_names;
  std::vector<ArrayShape> shapes = {};  // see TargetMap
  std::vector<Vec3> centred = {};  // the human points that T is estimated from, at the reference
  Indices columns;                 // see Hand.joint_columns
  nb::object plain_targets = module_of("mapping.method").object("Targets");
  nb::object command = module_of("mapping.method").object("RobotCommand");
  nb::object summary = module_of("mapping.method").object("StepSummary");
  nb::object statuses = module_of("ik.compiled").object("STATUSES");

  StepReader(const nb::object& robot, nb::object own_links, nb::object make_targets)
      : hand(robot), links(std::move(own_links)), targets(std::move(make_targets)),
        joint_names(nb::getattr(robot, "joint_names")),
        columns(Fields(robot).indices("joint_columns")) {}
};

// Of one hand, whose targets come from a map of Python.
inline std::shared_ptr<const StepReader> reader_of(const nb::object& target_map,
                                                   const nb::object& robot,
                                                   const nb::object& links) {
  auto reader = std::make_shared<StepReader>(robot, links, nb::getattr(target_map, "asked"));
  reader->shapes = Fields(target_map).get<const TargetMap&>("core").shapes();
  reader->centred = Fields(target_map).points("estimator.centred");
  return reader;
}

// `Stages` of a step, whose objects Python gets when it asks for them.
struct Stages : Step {
  std::shared_ptr<const StepReader> reader;
  HumanPose pose;
  nb::object asked_, ik_, command_, summary_;

  nb::object read_asked() {
    if (asked_.is_valid()) return asked_;
    if (!reader->targets.is_none())
      return asked_ = reader->targets(parts_of(asked, reader->shapes), asked.is_clamped);
    const nb::object flags = asked.is_clamped ? nb::make_tuple("stretch_clamped") : nb::tuple();
    return asked_ = reader->plain_targets(array_of(asked.points), array_of(asked.wrist),
                                          nb::arg("flags") = flags);
  }
  nb::object read_command() {
    if (!command_.is_valid())
      command_ = reader->command(reader->joint_names, array_of(q), array_of(result.wrists[0]));
    return command_;
  }
  nb::object status() const { return item(reader->statuses, static_cast<size_t>(result.status)); }

  // `StepSummary`, without the objects of Python that its numbers would need.
  nb::object read_summary() {
    if (summary_.is_valid()) return summary_;
    nb::list point_error, at_bound;
    for (size_t k = 0; k < result.points.size(); ++k)
      point_error.append(norm(result.targets[k] - result.points[k]));
    for (const int column : reader->columns) at_bound.append(result.active[column] != 0);
    const Pose &wrist = result.wrists[0], &target = asked.wrist;
    const nb::tuple wrist_error = nb::make_tuple(
        norm(wrist.p - target.p), norm(log3(transposed(target.R) * wrist.R)));
    const nb::object flags = asked.is_clamped ? nb::getattr(read_asked(), "flags") : nb::tuple();
    return summary_ = reader->summary(point_error, wrist_error, at_bound, residual(), flags);
  }

 private:
  // RMS distance of the human points from where T takes them [m]; 0 without T. The diagnostics of
  // every map begin with T's linear part, the centroid after the motion and the points after it.
  double residual() const {
    if (reader->centred.empty()) return 0.0;
    const double* from = asked.diagnostics.data();
    Mat3 linear;
    std::copy(from, from + 9, linear.m);
    const Vec3 centroid{from[9], from[10], from[11]};
    from += 12;
    double sum = 0.0;
    for (const Vec3& before : reader->centred) {
      const Vec3 after = Vec3{from[0], from[1], from[2]} - centroid;
      const Vec3 off = after - linear * before;
      sum += dot(off, off);
      from += 3;
    }
    return std::sqrt(sum / static_cast<double>(reader->centred.size()));
  }
};

// Stages to be filled, and the object of Python that owns them.
inline std::pair<nb::object, Stages&> new_stages(std::shared_ptr<const StepReader> reader) {
  nb::object made = nb::inst_alloc(nb::type<Stages>());
  Stages& stages = *new (nb::inst_ptr<Stages>(made)) Stages();
  nb::inst_mark_ready(made);
  stages.reader = std::move(reader);
  return {made, stages};
}

inline nb::object read_ik(const nb::object& self) {
  Stages& stages = nb::cast<Stages&>(self);
  if (!stages.ik_.is_valid())
    stages.ik_ = result_of(stages, stages.reader->hand, stages.reader->links);
  return stages.ik_;
}

// A copy, by copy or pickle, is one of Python: this one moves on.
inline nb::tuple reduced(const nb::object& self) {
  Stages& stages = nb::cast<Stages&>(self);
  const nb::object kind = module_of("mapping.method").object("Stages");
  return nb::make_tuple(kind, nb::make_tuple(nb::getattr(self, "pose"), stages.read_asked(),
                                             read_ik(self), stages.read_command()));
}

// Reads the samples after a reference as they come in, and hands them on; one call each.
class SampleReader {
 public:
  // `target_map` is one of Python, with a core.
  explicit SampleReader(const nb::object& target_map)
      : map_owner_(target_map), map_(Fields(target_map).get<const TargetMap&>("core")),
        map_step_(module_of("mapping.method").object("MapStep")) {}
  SampleReader(const SampleReader&) = delete;
  virtual ~SampleReader() = default;

  // The stages for a pose.
  nb::object follow(const nb::object& pose, const nb::object& when, double speed) {
    return moved(pose_from(pose), when_from(when), speed);
  }

  // Map a sample as it comes in; None for one that Python has to look at.
  nb::object map_joints(JointReader* reader, const nb::object& q, const nb::object& wrist,
                        const nb::object& dt) {
    const Clock::time_point started = Clock::now();
    return step_of(read_joints(reader, q, wrist), dt, started);
  }
  nb::object map_landmarks(const LandmarkReader* reader, const nb::object& landmarks,
                           const nb::object& wrist, const nb::object& dt) {
    const Clock::time_point started = Clock::now();
    return step_of(read_landmarks(reader, landmarks, wrist), dt, started);
  }

  // Judge a `HumanSample` and map it. Return the step; only the verdict about a sample that is to be
  // held, or that the follower returns with; or None for one that Python has to judge. `origin` is
  // where the stream's time begins on the robot's clock [s]; None if that is not known.
  nb::object map_sample(PythonGuard& guard, PythonSmoother& smoother, const LandmarkReader& reader,
                        const nb::object& sample, const nb::object& dt, const nb::object& arrival,
                        const nb::object& origin) {
    std::optional<When> given;
    if (!dt.is_none() && !(given = plain_when(dt))) return nb::none();
    if (!given && origin.is_none()) return nb::none();
    if (!guard.is_own(sample)) return nb::none();
    const PythonGuard::Given from(guard, sample, arrival);
    std::optional<Pose> wrist;
    if (from.sample.wrist && !(wrist = exact_pose(from.sample.wrist))) return nb::none();
    if (from.sample.valid && !is_near(from.sample.landmarks, 3 * kLandmarks)) return nb::none();
    const Work judging(guard), smoothing(smoother);
    const double last = given ? 0.0 : last_time();
    const Verdict verdict = guard.judge_one(from.sample);
    nb::object said = guard.verdict_of(verdict);
    if (verdict.is_held || verdict.is_return) return said;
    // Python relates the stream's clock to the robot's.
    const double time = given ? 0.0 : nb::cast<double>(origin) + verdict.time;
    if (!given && last - time > kBehind) return said;
    const Clock::time_point started = Clock::now();
    try {
      const double speed = verdict.rule == kUnproven ? kUnprovenSpeed : 1.0;
      const double granted = given ? given->own_time() : std::max(verdict.dt, kShortestDt);
      HumanPose pose = reader.read(from.sample.landmarks, wrist ? &*wrist : nullptr);
      const When when = given ? *given : When::at(time, granted);
      nb::object stages = moved(smoother.smoother.smooth(std::move(pose), granted), when, speed);
      return map_step_(stages, nb::tuple(), seconds_since(started), said, from.sample.confidence);
    } catch (...) {
      guard.forget();
      smoother.smoother.forget();
      throw;
    }
  }

 protected:
  nb::object map_owner_;
  const TargetMap& map_;

  virtual nb::object moved(HumanPose&& pose, const When& when, double speed) = 0;
  // Instant of the robot's last command, on its clock [s].
  virtual double last_time() = 0;

 private:
  using Clock = std::chrono::steady_clock;

  nb::object map_step_;

  static double seconds_since(Clock::time_point started) {
    return std::chrono::duration<double>(Clock::now() - started).count();
  }

  nb::object step_of(std::optional<HumanPose>&& pose, const nb::object& given,
                     Clock::time_point started) {
    const std::optional<When> when = plain_when(given);
    if (!pose || !when) return nb::none();
    nb::object stages = moved(std::move(*pose), *when, 1.0);
    return map_step_(stages, nb::tuple(), seconds_since(started));
  }
};

// What a `HandMapper` does with the samples after its reference.
class SampleMapper : public SampleReader {
 public:
  // Of a core's `Ik`, its hand, and a map of Python with a core.
  SampleMapper(nb::object ik, const nb::object& robot, const nb::object& target_map)
      : SampleReader(target_map), ik_owner_(std::move(ik)),
        ik_(nb::cast<PythonIk&>(ik_owner_)), reader_(reader_of(target_map, robot, ik_.links)) {}

  // Map samples of a recording, whose time begins at `origin` on the robot's clock; see run.hpp.
  // Return the first that is left out, the verdict about it if it was judged, and the pose that was
  // mapped last, if any.
  nb::tuple run(PythonGuard& guard, PythonSmoother& smoother, const LandmarkReader& reader,
                double origin, const nb::object& columns, size_t first, size_t last,
                const nb::ndarray<double, nb::c_contig, nb::device::cpu>& rows) {
    const Samples samples(columns, true);
    const size_t width = row_width(ik_);
    if (last > samples.count || rows.ndim() != 2 || rows.shape(0) != samples.count ||
        rows.shape(1) != width)
      throw std::invalid_argument("wrong sizes of samples or rows");
    check_map(ik_, map_, {std::vector<Vec3>(reader.used.size()), true, {}});
    const Work moving(ik_), judging(guard), smoothing(smoother);
    Run run{ik_, map_, reader, guard.guard, smoother.smoother, origin};
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
    return nb::make_tuple(next, run.leaves ? guard.verdict_of(run.verdict) : nb::none(),
                          run.has_seen ? nb::cast(std::move(run.seen)) : nb::none());
  }

 protected:
  nb::object moved(HumanPose&& pose, const When& when, double speed) override {
    check_map(ik_, map_, pose);
    const Work moving(ik_);
    auto [made, stages] = new_stages(reader_);
    stages.pose = std::move(pose);
    handmap::follow(ik_, map_, stages.pose, when, speed, goal_, stages);
    return made;
  }
  double last_time() override {
    const Work reading(ik_);
    return ik_.motion.time;
  }

 private:
  nb::object ik_owner_;
  PythonIk& ik_;
  std::shared_ptr<const StepReader> reader_;
  Goal goal_;
};

// A mapper of Python that is copied makes its own: None takes the place of this one.
template <class T>
nb::tuple without_copy(const T&) {
  return nb::make_tuple(nb::none().type(), nb::tuple());
}

}  // namespace handmap
