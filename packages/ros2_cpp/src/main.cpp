// Runs the node until Ctrl-C.
#include <cstdio>

#include "hand_node.hpp"

int main(int count, char** arguments) {
  rclcpp::init(count, arguments);
  try {
    rclcpp::spin(std::make_shared<handmap_ros2::HandNode>());
  } catch (const std::exception& error) {
    std::fprintf(stderr, "handmap: %s\n", error.what());
    rclcpp::shutdown();
    return 1;
  }
  rclcpp::shutdown();
}
