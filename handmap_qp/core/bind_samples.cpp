// Samples of a human hand to targets and commands of one hand.
#include <nanobind/stl/optional.h>

#include "bind.hpp"
#include "robot.hpp"

using namespace nb::literals;

namespace handmap {
namespace {

nb::object wrist_of(const HumanPose& pose) {
  return pose.has_wrist ? array_of(pose.wrist) : nb::none();
}

// A copy of a pose, by copy or pickle, is one of Python.
nb::tuple reduced_pose(const HumanPose& pose) {
  const nb::object kind = module_of("mapping.method").object("HumanPose");
  return nb::make_tuple(kind, nb::make_tuple(array_of(pose.points), wrist_of(pose)));
}

}  // namespace

void bind_samples(nb::module_& m) {
  nb::class_<HumanPose>(m, "HumanPose")
      .def("__reduce__", &reduced_pose)
      .def_prop_ro("points", [](const HumanPose& pose) { return array_of(pose.points); })
      .def_prop_ro("in_wrist", [](const HumanPose& pose) { return array_of(pose.in_wrist()); })
      .def_prop_ro("wrist", &wrist_of);
  nb::class_<TargetMap>(m, "TargetMap");
  nb::class_<TeleoperationMap, TargetMap>(m, "TeleoperationMap")
      .def("__init__", &make_teleoperation);
  nb::class_<HomogeneousMap, TargetMap>(m, "HomogeneousMap").def("__init__", &make_homogeneous);
  nb::class_<LandmarkReader>(m, "LandmarkReader")
      .def("__init__", &make_landmark_reader)
      .def("read", &read_landmarks, "landmarks"_a.none(), "wrist"_a.none());
  nb::class_<JointReader>(m, "JointReader")
      .def(nb::init<const Tree&>(), "tree"_a)
      .def("read", &read_joints, "q"_a.none(), "wrist"_a.none());
  nb::class_<Stages>(m, "Stages")
      .def("__reduce__", &reduced)
      .def_ro("pose", &Stages::pose)
      .def_prop_ro("status", &Stages::status)
      .def_prop_ro("summary", &Stages::read_summary)
      .def_prop_ro("asked", &Stages::read_asked)
      .def_prop_ro("ik", &read_ik)
      .def_prop_ro("command", &Stages::read_command);
  nb::class_<SampleReader>(m, "SampleReader")
      .def("__reduce__", &without_copy<SampleReader>)
      .def("follow", &SampleReader::follow)
      .def("map", &SampleReader::map_joints, "reader"_a.none(), "q"_a.none(), "wrist"_a.none(),
           "dt"_a.none())
      .def("map", &SampleReader::map_landmarks, "reader"_a.none(), "landmarks"_a.none(),
           "wrist"_a.none(), "dt"_a.none())
      .def("map_sample", &SampleReader::map_sample, "guard"_a, "smoother"_a, "reader"_a,
           "sample"_a.none(), "dt"_a.none(), "arrival"_a.none(), "origin"_a.none());
  nb::class_<SampleMapper, SampleReader>(m, "SampleMapper")
      .def(nb::init<nb::object, const nb::object&, const nb::object&>(), "ik"_a, "robot"_a,
           "target_map"_a)
      .def("run", &SampleMapper::run);
  nb::class_<Asker, SampleReader>(m, "Asker")
      .def(nb::init<const PythonIk&, const nb::object&, const nb::object&>(), "ik"_a, "hand"_a,
           "target_map"_a);
  nb::class_<Ask>(m, "Ask")
      .def("__reduce__", &reduced_ask)
      .def_ro("pose", &Ask::pose)
      .def_ro("map", &Ask::target_map)
      .def_ro("dt", &Ask::dt)
      .def_ro("speed", &Ask::speed)
      .def_prop_ro("rest", &Ask::rest)
      .def_prop_ro("targets", &Ask::read_targets);
}

}  // namespace handmap
