// Stand-in for ROS 2: the fields of geometry_msgs/msg/PoseArray.
#pragma once

#include <memory>
#include <vector>

#include <geometry_msgs/msg/pose.hpp>
#include <std_msgs/msg/header.hpp>

namespace geometry_msgs::msg {

struct PoseArray {
  using ConstSharedPtr = std::shared_ptr<const PoseArray>;

  std_msgs::msg::Header header;
  std::vector<Pose> poses;
};

}  // namespace geometry_msgs::msg
