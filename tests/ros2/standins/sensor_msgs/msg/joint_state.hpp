// Stand-in for ROS 2: the fields of sensor_msgs/msg/JointState.
#pragma once

#include <string>
#include <vector>

#include <std_msgs/msg/header.hpp>

namespace sensor_msgs::msg {

struct JointState {
  std_msgs::msg::Header header;
  std::vector<std::string> name;
  std::vector<double> position, velocity, effort;
};

}  // namespace sensor_msgs::msg
