// Samples of a human hand to targets and commands of one hand.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>

#include "bind.hpp"
#include "handmap/palm_reference.hpp"
#include "handmap/rejoin.hpp"
#include "robot.hpp"

using namespace nb::literals;

namespace handmap {
namespace {

nb::object wrist_of(const HumanPose& pose) {
  return pose.has_wrist ? array_of(pose.wrist) : nb::none();
}

// The targets of a sample: their arrays, and whether a stretch is clamped.
std::pair<nb::list, bool> targets_of(const TargetMap& map, const HumanPose& pose) {
  check_pose(map, pose);
  Targets targets;
  map.targets(pose.points, pose.has_wrist ? &pose.wrist : nullptr, targets);
  return {arrays_of(targets, &map), targets.is_clamped};
}

Pose read_pose(const Array& matrix) {
  expect_size(matrix, 16, "pose");
  return pose_of(matrix.data());
}

// The sample of numbers that Python has checked.
HumanPose pose_of_landmarks(const LandmarkReader& reader, const Array& landmarks,
                            const std::optional<Array>& wrist) {
  expect_size(landmarks, 3 * kLandmarks, "landmarks");
  if (!wrist) return reader.read(landmarks.data(), nullptr);
  const Pose measured = read_pose(*wrist);
  return reader.read(landmarks.data(), &measured);
}

HumanPose pose_of_joints(JointReader& reader, const Array& q, const Array& wrist) {
  expect_size(q, reader.size(), "q");
  return reader.read(q.data(), read_pose(wrist));
}

// Rows of three numbers as an array (n, 3); numpy takes four times as long.
NumpyArray array_of_rows(const nb::tuple& rows) {
  double* to;
  NumpyArray made = array_of({rows.size(), 3}, to);
  for (const nb::handle row : rows) {
    expect(PyTuple_Check(row.ptr()) && PyTuple_Size(row.ptr()) == 3, "a row of another size");
    for (Py_ssize_t i = 0; i < 3; ++i) {
      const double number = PyFloat_AsDouble(PyTuple_GetItem(row.ptr(), i));
      if (number == -1.0 && PyErr_Occurred()) nb::raise_python_error();
      *to++ = number;
    }
  }
  return made;
}

// The distances from the thumb's tip to the other tips; see contact_gap.tip_gaps.
nb::list tip_gaps(const nb::handle& landmarks) {
  const Borrowed points(landmarks, {kLandmarks, 3});
  expect(points.data, "wrong size of landmarks");
  constexpr int kTip = 4;  // the thumb's; the others follow each by as many
  const auto tip = [&](int i) {
    const double* at = points.data + 3 * i;
    return Vec3{at[0], at[1], at[2]};
  };
  nb::list gaps;
  for (int i = 2 * kTip; i < kLandmarks; i += kTip) gaps.append(norm(tip(i) - tip(kTip)));
  return gaps;
}

// The motions of both hands, the offset, and its share of the weight, of palms that meet.
std::optional<std::tuple<nb::object, nb::object, nb::object, double>> meeting(
    const LedPalm& first, const Array& first_wrist, const LedPalm& other, const Array& other_wrist,
    double near, double together) {
  const std::optional<Meeting> found = meeting_of(
      {first, other}, {read_pose(first_wrist), read_pose(other_wrist)}, near, together);
  if (!found) return {};
  return std::make_tuple(array_of(found->motions[0]), array_of(found->motions[1]),
                         array_of({3}, &found->aim.x), found->share);
}

// The palm of a reference: the robot's at it, the alignment, the robot's palm seen from the human's, its
// origin there, the rest of its place, and the human's anchor; see PalmMap.
nb::tuple palm_of_reference(const nb::bytes& following, const Array& human_wrist,
                            const Array& robot_wrist) {
  const PalmModel palm = palm_at(model_of<PalmFollowingModel>(following), read_pose(human_wrist),
                                 read_pose(robot_wrist));
  return nb::make_tuple(array_of(palm.start), array_of({3, 3}, palm.alignment.m),
                        array_of({3, 3}, palm.rotation.m), array_of({3}, &palm.origin.x),
                        array_of({3}, &palm.offset.x), array_of({3}, &palm.human_start.x));
}

// What is added to samples after a return, (n + 2, 3), and the time in which it fades.
std::pair<NumpyArray, double> offset_of_return(const HumanPose& pose, const HumanPose& seen,
                                               bool palm_fades, double lost) {
  expect(pose.has_wrist == seen.has_wrist && pose.points.size() == seen.points.size(),
         "poses of different hands");
  Offset offset;
  find_offset(pose, seen, offset);
  return {array_of(offset), fading_time(offset, palm_fades, lost)};
}

HumanPose pose_with_offset(HumanPose pose, const Array& offset, double left, bool palm_fades) {
  expect_size(offset, 3 * (pose.points.size() + 2), "offset");
  add_offset(points_of(offset), left, palm_fades, pose);
  return pose;
}

}  // namespace

void bind_samples(nb::module_& m) {
  m.attr("FADING_SPEEDS") = nb::make_tuple(kFadingFinger, kFadingPalm, kFadingTurn);
  m.def("palm_of_reference", &palm_of_reference, "following"_a, "human_wrist"_a, "robot_wrist"_a);
  m.def("start_palm",
        [](const nb::bytes& following, const Array& human_wrist) {
          return array_of(
              start_palm(model_of<PalmFollowingModel>(following), read_pose(human_wrist)));
        },
        "following"_a, "human_wrist"_a);
  m.def("minimum_jerk", &minimum_jerk, "share"_a);
  m.def("offset_of_return", &offset_of_return, "pose"_a, "seen"_a, "palm_fades"_a, "lost"_a);
  m.def("pose_with_offset", &pose_with_offset, "pose"_a, "offset"_a, "left"_a, "palm_fades"_a);
  m.def("array_of_rows", &array_of_rows, "rows"_a);
  m.def("tip_gaps", &tip_gaps, "landmarks"_a);
  nb::class_<HumanPose>(m, "HumanPose")
      .def("__init__",
           [](HumanPose* self, const Array& points, const std::optional<Array>& wrist) {
             new (self) HumanPose(make_pose(points, wrist));
           },
           "points"_a, "wrist"_a.none())
      .def_prop_ro("points", [](const HumanPose& pose) { return array_of(pose.points); })
      .def_prop_ro("wrist", &wrist_of);
  nb::class_<PalmMap>(m, "PalmMap")
      .def("__init__",
           [](PalmMap* self, const nb::bytes& model) {
             new (self) PalmMap{model_of<PalmModel>(model)};
           },
           "model"_a)
      .def("follow",
           [](const PalmMap& map, const Array& human) {
             return array_of(map.follow(read_pose(human)));
           },
           "human"_a)
      .def("person_at",
           [](const PalmMap& map, const Array& wrist) {
             return array_of(map.person_at(read_pose(wrist)));
           },
           "wrist"_a);
  nb::class_<LedPalm>(m, "LedPalm")
      .def("__init__",
           [](LedPalm* self, const PalmMap& map, const Array& person) {
             new (self) LedPalm{&map, read_pose(person)};
           },
           nb::keep_alive<1, 2>(), "map"_a, "person"_a)
      .def("turn",
           [](const LedPalm& palm, const Array& wrist, double share) {
             return array_of(palm.turn(read_pose(wrist), share));
           },
           "wrist"_a, "share"_a)
      .def("meeting", &meeting, "wrist"_a, "other"_a, "other_wrist"_a, "near"_a, "together"_a);
  nb::class_<TargetMap>(m, "TargetMap").def("targets", &targets_of, "pose"_a);
  nb::class_<TeleoperationMap, TargetMap>(m, "TeleoperationMap")
      .def("__init__",
           [](TeleoperationMap* self, const nb::bytes& model, const nb::bytes& palm) {
             new (self)
                 TeleoperationMap(model_of<TeleoperationModel>(model), {model_of<PalmModel>(palm)});
           },
           "model"_a, "palm"_a);
  nb::class_<HomogeneousMap, TargetMap>(m, "HomogeneousMap")
      .def("__init__",
           [](HomogeneousMap* self, const nb::bytes& model) {
             new (self) HomogeneousMap(model_of<HomogeneousModel>(model));
           },
           "model"_a);
  nb::class_<LandmarkReader>(m, "LandmarkReader")
      .def("__init__",
           [](LandmarkReader* self, const nb::bytes& model) {
             new (self) LandmarkReader(model_of<LandmarkReaderModel>(model));
           },
           "model"_a)
      .def("read", &read_landmarks, "landmarks"_a.none(), "wrist"_a.none())
      .def("pose_of", &pose_of_landmarks, "landmarks"_a, "wrist"_a.none());
  nb::class_<JointReader>(m, "JointReader")
      .def(nb::init<const Tree&>(), "tree"_a)
      .def("read", &read_joints, "q"_a.none(), "wrist"_a.none())
      .def("pose_of", &pose_of_joints, "q"_a, "wrist"_a);
  nb::class_<StepViews>(m, "StepViews")
      .def(nb::init<nb::callable, nb::callable, nb::callable, nb::callable>(), "targets"_a, "ik"_a,
           "command"_a, "summary"_a);
  nb::class_<Stages, Step>(m, "Stages")
      .def_ro("pose", &Stages::pose)
      .def_prop_ro("summary", &Stages::read_summary)
      .def_prop_ro("asked", &Stages::read_targets)
      .def_prop_ro("ik", &read_ik)
      .def_prop_ro("command", &Stages::read_command);
  nb::class_<SampleReader>(m, "SampleReader")
      .def("__reduce__", &without_copy<SampleReader>)
      .def("follow", &SampleReader::follow, "pose"_a, "when"_a, "speed"_a)
      .def("map", &SampleReader::map_joints, "reader"_a.none(), "q"_a.none(), "wrist"_a.none(),
           "when"_a)
      .def("map", &SampleReader::map_landmarks, "reader"_a.none(), "landmarks"_a.none(),
           "wrist"_a.none(), "when"_a)
      .def("map_sample", &SampleReader::map_sample, "guard"_a, "smoother"_a, "reader"_a, "time"_a,
           "landmarks"_a, "wrist"_a.none(), "valid"_a, "confidence"_a, "when"_a.none(),
           "arrival"_a.none(), "origin"_a.none());
  nb::class_<HandMapper, SampleReader>(m, "HandMapper")
      .def(nb::init<std::shared_ptr<Ik>, std::shared_ptr<const TargetMap>, StepViews>(),
           "ik"_a, "target_map"_a, "views"_a)
      .def("run", &HandMapper::run, "guard"_a, "smoother"_a, "reader"_a, "origin"_a, "samples"_a,
           "first"_a, "last"_a, "rows"_a.noconvert());
  nb::class_<TargetSource, SampleReader>(m, "TargetSource")
      .def(nb::init<const Ik&, std::shared_ptr<const TargetMap>, StepViews, nb::object>(),
           "ik"_a, "target_map"_a, "views"_a, "python_map"_a);
  nb::class_<HandRequest>(m, "HandRequest")
      .def_ro("pose", &HandRequest::pose)
      .def_ro("map", &HandRequest::python_map)
      .def_ro("dt", &HandRequest::dt)
      .def_ro("speed", &HandRequest::speed)
      .def_prop_ro("rest", &HandRequest::rest)
      .def_prop_ro("targets", &HandRequest::read_targets);
}

}  // namespace handmap
