// A node of rclcpp in which a saved hand follows the landmarks of a person: `HandNode`.
#pragma once

#include <array>
#include <memory>
#include <string>
#include <vector>

#include <diagnostic_msgs/msg/diagnostic_array.hpp>
#include <geometry_msgs/msg/pose_array.hpp>
#include <geometry_msgs/msg/pose_stamped.hpp>
#include <handmap/handmap.h>
#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/joint_state.hpp>
#include <std_msgs/msg/float64_multi_array.hpp>
#include <std_srvs/srv/trigger.hpp>
#include <trajectory_msgs/msg/joint_trajectory.hpp>

namespace handmap_ros2 {

// Subscribes to `human/landmarks`, and publishes commands as the node of `packages/ros2` does. The
// services are `stop`, `clear`, `engage` and `disengage`.
//
// One thread calls it: spin it by a single-threaded executor, as `main` does.
class HandNode : public rclcpp::Node {
 public:
  // Throws std::runtime_error if the parameter `robot` names no saved hand of this version.
  HandNode();

 private:
  using Trigger = std_srvs::srv::Trigger;
  struct Free {
    void operator()(handmap_follower* hand) const { handmap_free(hand); }
  };

  std::unique_ptr<handmap_follower, Free> hand_;
  std::string session_;
  std::vector<std::string> joint_names_;
  double usual_dt_;  // between samples [s]

  rclcpp::Clock steady_{RCL_STEADY_TIME};
  double last_sample_ = 0.0;   // when it came, on the steady clock [s]
  double last_command_ = 0.0;  // when it was published [s]
  double last_report_ = 0.0;   // of silence [s]
  bool has_commands_ = false;  // whether one was published
  bool is_stopped_ = false;    // by `stop`, until `clear`

  rclcpp::Publisher<sensor_msgs::msg::JointState>::SharedPtr joints_;
  rclcpp::Publisher<geometry_msgs::msg::PoseStamped>::SharedPtr wrist_;
  rclcpp::Publisher<trajectory_msgs::msg::JointTrajectory>::SharedPtr trajectory_;
  rclcpp::Publisher<std_msgs::msg::Float64MultiArray>::SharedPtr forward_;
  rclcpp::Publisher<diagnostic_msgs::msg::DiagnosticArray>::SharedPtr diagnostics_;
  rclcpp::Subscription<geometry_msgs::msg::PoseArray>::SharedPtr landmarks_;
  std::vector<rclcpp::Service<Trigger>::SharedPtr> services_;
  rclcpp::TimerBase::SharedPtr timer_;

  void load(const std::string& file);
  void on_landmarks(const geometry_msgs::msg::PoseArray& message);
  void on_timer();

  // What services do. Each returns what went wrong, or nothing.
  std::string stop();
  std::string clear();
  std::string engage();
  std::string disengage();
  void serve(const std::string& name, std::string (HandNode::*act)());

  // Time that the robot has for a command at an instant of the steady clock [s].
  double time_since_command(double now) const;
  void publish(const handmap_command& command, double now, double dt);
  void report(unsigned char level, const std::string& text, const std::string& rule);
  void warn(const std::string& problem);
};

}  // namespace handmap_ros2
