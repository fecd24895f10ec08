// Stand-in for ROS 2: the field of std_msgs/msg/Float64MultiArray that is used.
#pragma once

#include <vector>

namespace std_msgs::msg {

struct Float64MultiArray {
  std::vector<double> data;
};

}  // namespace std_msgs::msg
