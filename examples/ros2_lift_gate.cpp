// A ROS 2 node that lifts only on a fresh LIFT of blindgrasp. Needs ROS 2 with rmw_zenoh and the package blindgrasp_msgs.
//
// Put the motion of your arm into lift(). Nothing else may start it.

#include <chrono>
#include <cstdint>
#include <optional>

#include <blindgrasp_msgs/msg/decision.hpp>
#include <rclcpp/rclcpp.hpp>

using blindgrasp_msgs::msg::Decision;

class LiftGate : public rclcpp::Node {
public:
  LiftGate() : Node("lift_gate") {
    // The last decision is kept for a node that starts late: it may be an old one.
    const auto qos = rclcpp::QoS(1).reliable().transient_local();
    subscription_ = create_subscription<Decision>(
        "/blindgrasp/decision", qos, [this](const Decision &decision) { on_decision(decision); });
  }

private:
  void on_decision(const Decision &decision) {
    const auto grasp = static_cast<unsigned long long>(decision.grasp_id);
    if (decision.action != Decision::LIFT) {
      RCLCPP_INFO(get_logger(), "grasp %llu: hold, %s", grasp, decision.reason.c_str());
      return;
    }
    // valid_until is a time of the wall clock, whatever use_sim_time says; the clocks of two machines must agree (NTP).
    using std::chrono::duration_cast;
    using std::chrono::nanoseconds;
    const auto now = duration_cast<nanoseconds>(std::chrono::system_clock::now().time_since_epoch()).count();
    const auto until = std::int64_t{decision.valid_until.sec} * 1'000'000'000 + decision.valid_until.nanosec;
    if (now >= until) {
      RCLCPP_WARN(get_logger(), "grasp %llu: LIFT is no longer valid, hold", grasp);
      return;
    }
    // A grasp is lifted once, however often its decision comes.
    if (lifted_grasp_ != decision.grasp_id) {
      lifted_grasp_ = decision.grasp_id;
      lift(decision);
    }
  }

  void lift(const Decision &decision) {
    RCLCPP_INFO(get_logger(), "grasp %llu: lift, probability %.2f",
                static_cast<unsigned long long>(decision.grasp_id), decision.probability_stable);
  }

  rclcpp::Subscription<Decision>::SharedPtr subscription_;
  std::optional<std::uint64_t> lifted_grasp_;
};

int main(int argc, char **argv) {
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<LiftGate>());
  rclcpp::shutdown();
}
