// Drives the node in C++ on stand-ins for ROS 2, and prints what it publishes as lines of JSON.
//
//     drive_node FILE.hand < REQUESTS
//
// A request is a line: `landmarks TIME STAMP X Y Z ...` (21 points, or none), `tick TIME`, or
// `call TIME SERVICE`. TIME is that of all clocks [s].
#include <cstdio>
#include <iostream>
#include <sstream>

#include "hand_node.hpp"

namespace {

using geometry_msgs::msg::PoseArray;
using std_srvs::srv::Trigger;

void send_landmarks(std::istringstream& words) {
  auto message = std::make_shared<PoseArray>();
  double stamp = 0.0;
  words >> stamp;
  message->header.stamp = rclcpp::Time(stamp);
  geometry_msgs::msg::Pose pose;
  while (words >> pose.position.x >> pose.position.y >> pose.position.z)
    message->poses.push_back(pose);
  using Callback = std::function<void(PoseArray::ConstSharedPtr)>;
  std::any_cast<Callback>(standin::callbacks.at("human/landmarks"))(message);
}

std::string call(const std::string& service) {
  using Callback = std::function<void(std::shared_ptr<Trigger::Request>,
                                      std::shared_ptr<Trigger::Response>)>;
  auto response = std::make_shared<Trigger::Response>();
  std::any_cast<Callback>(standin::callbacks.at(service))(std::make_shared<Trigger::Request>(), response);
  return response->success ? "done" : response->message;
}

template <class Numbers>
void print_list(const char* name, const Numbers& numbers) {
  std::printf(", \"%s\": [", name);
  for (size_t i = 0; i < numbers.size(); ++i) std::printf("%s%.17g", i ? ", " : "", numbers[i]);
  std::printf("]");
}

// Print what was published since the request before, and forget it.
void print(const std::string& answer) {
  std::printf("{\"answer\": \"%s\"", answer.c_str());
  const auto& joints = standin::messages<sensor_msgs::msg::JointState>("joint_commands");
  std::printf(", \"commands\": %zu", joints.size());
  if (!joints.empty()) {
    const auto& wrist = standin::messages<geometry_msgs::msg::PoseStamped>("wrist_command").back();
    const auto& path = standin::messages<trajectory_msgs::msg::JointTrajectory>(
                           "/hand_controller/joint_trajectory")
                           .back();
    const auto& forward =
        standin::messages<std_msgs::msg::Float64MultiArray>("/hand_controller/commands").back();
    print_list("q", joints.back().position);
    print_list("trajectory", path.points.at(0).positions);
    print_list("forward", forward.data);
    const auto& at = wrist.pose;
    print_list("wrist", std::vector<double>{at.position.x, at.position.y, at.position.z,
                                            at.orientation.x, at.orientation.y, at.orientation.z,
                                            at.orientation.w});
    const auto& step = path.points[0].time_from_start;
    std::printf(", \"dt\": %.9f, \"names\": [", step.sec + 1e-9 * step.nanosec);
    for (size_t j = 0; j < joints.back().name.size(); ++j)
      std::printf("%s\"%s\"", j ? ", " : "", joints.back().name[j].c_str());
    std::printf("]");
  }
  const auto& reports = standin::messages<diagnostic_msgs::msg::DiagnosticArray>("/diagnostics");
  if (!reports.empty()) {
    const auto& status = reports.back().status.at(0);
    std::printf(", \"level\": %d, \"status\": \"%s\"", status.level, status.message.c_str());
  }
  std::printf(", \"warnings\": %zu}\n", standin::warnings.size());
  standin::published.clear();
  standin::warnings.clear();
}

void drive(const std::string& line) {
  std::istringstream words(line);
  std::string kind, service;
  words >> kind >> standin::time;
  std::string answer;
  if (kind == "landmarks") send_landmarks(words);
  else if (kind == "tick") standin::timer();
  else if (words >> service) answer = call(service);
  print(answer);
}

}  // namespace

int main(int count, char** arguments) {
  if (count > 1) standin::parameters["robot"] = arguments[1];
  try {
    const handmap_ros2::HandNode node;
    std::string line;
    while (std::getline(std::cin, line)) drive(line);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "handmap: %s\n", error.what());
    return 1;
  }
}
