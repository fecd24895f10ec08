// The models that the core is made of, as a test compares them with those of Python.
#include <nanobind/nanobind.h>

#include "bind.hpp"
#include "handmap/follower_model.hpp"
#include "handmap/robot_model.hpp"

using namespace nb::literals;

namespace handmap {
namespace {

template <class Model>
void add(nb::dict& models) {
  nb::list fields;
  for (const auto& [name, form] : fields_of<Model>())
    fields.append(nb::make_tuple(nb::str(name.c_str()), nb::str(form.c_str())));
  models[Model::kName] = fields;
}

// Names and forms of the fields of each model, in their order.
nb::dict model_fields() {
  nb::dict models;
  add<JointModel>(models);
  add<FrameModel>(models);
  add<PlaceModel>(models);
  add<HandModel>(models);
  add<BoxLimits>(models);
  add<ShapeModel>(models);
  add<BodyModel>(models);
  add<PairsModel>(models);
  add<ContactYield>(models);
  add<CollisionModel>(models);
  add<IkModel>(models);
  add<EstimatorModel>(models);
  add<PalmModel>(models);
  add<DistancesModel>(models);
  add<TeleoperationModel>(models);
  add<HomogeneousModel>(models);
  add<GuardModel>(models);
  add<LandmarkReaderModel>(models);
  add<PalmFollowingModel>(models);
  add<FollowerModel>(models);
  add<RobotHandModel>(models);
  add<RobotModel>(models);
  return models;
}

}  // namespace

void bind_models(nb::module_& m) { m.def("model_fields", &model_fields); }

}  // namespace handmap
