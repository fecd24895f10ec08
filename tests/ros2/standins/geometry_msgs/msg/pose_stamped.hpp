// Stand-in for ROS 2: the fields of geometry_msgs/msg/PoseStamped.
#pragma once

#include <geometry_msgs/msg/pose.hpp>
#include <std_msgs/msg/header.hpp>

namespace geometry_msgs::msg {

struct PoseStamped {
  std_msgs::msg::Header header;
  Pose pose;
};

}  // namespace geometry_msgs::msg
