// A ROS 2 node round an exported filter: sensor_msgs/Imu and NavSatFix with TwistWithCovarianceStamped in, Odometry out.
//
// In a package's CMakeLists.txt, beside the folder of the export as dlkf/:
//   add_library(dlkf_step dlkf/step.c)                   # with the options of dlkf/CMakeLists.txt
//   add_executable(dlkf_node dlkf/ros2_node.cpp)
//   ament_target_dependencies(dlkf_node rclcpp sensor_msgs geometry_msgs nav_msgs)
//   target_link_libraries(dlkf_node dlkf_step)
//
// imu/data comes at DLKF_RATE_HZ in forward-left-up (REP 103) and is turned to forward-right-down; fix_velocity is the
// receiver's velocity East-North-Up with the stamp of its fix. A fix counts at the end of the epoch in which it was taken;
// where it comes after that, the filter takes this epoch once more, and what comes later still is left out.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <memory>
#include <vector>

#include <geometry_msgs/msg/twist_with_covariance_stamped.hpp>
#include <nav_msgs/msg/odometry.hpp>
#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/imu.hpp>
#include <sensor_msgs/msg/nav_sat_fix.hpp>

#include "step.h"

class DlkfNode : public rclcpp::Node {
 public:
  DlkfNode() : Node("dlkf") {
    arm_ = declare_parameter("lever_arm_b", std::vector<double>{0, 0, 0});
    for (auto& fix : fixes_) fix.fill(NAN);
    fix_.fill(NAN);
    imu_ = create_subscription<sensor_msgs::msg::Imu>("imu/data", 200, [this](sensor_msgs::msg::Imu::ConstSharedPtr m) { imu(*m); });
    gnss_ = create_subscription<sensor_msgs::msg::NavSatFix>("fix", 10, [this](sensor_msgs::msg::NavSatFix::ConstSharedPtr m) { fix(*m); });
    velocity_ = create_subscription<geometry_msgs::msg::TwistWithCovarianceStamped>(
        "fix_velocity", 10, [this](geometry_msgs::msg::TwistWithCovarianceStamped::ConstSharedPtr m) {
          const auto& v = m->twist.twist.linear;
          velocity_t_ = rclcpp::Time(m->header.stamp).seconds();
          v_ned_ = {v.y, v.x, -v.z};
          if (together()) offer();
        });
    odometry_ = create_publisher<nav_msgs::msg::Odometry>("odometry", 10);
  }

 private:
  static constexpr int W = DLKF_BEGIN_EPOCHS;
  static constexpr double EPOCH_S = DLKF_SAMPLES / DLKF_RATE_HZ, ON_BOUNDARY_S = 1e-3, TOGETHER_S = 0.02;
  std::vector<double> arm_;
  std::array<double, 3> v_ned_{NAN, NAN, NAN};
  double samples_[W + 1][DLKF_SAMPLES][6];              // the epochs of an alignment, and the open one
  std::array<std::array<double, DLKF_FIX>, W + 2> fixes_;  // at the boundaries of those
  std::array<double, DLKF_FIX> fix_;                    // the last one
  double memory_[2][DLKF_MEMORY], moved_[DLKF_MEMORY], row_[DLKF_ROW];  // before and after the last epoch
  double end_ = NAN, fix_t_ = NAN, velocity_t_ = NAN;   // of the last epoch, of fix_, of v_ned_
  int count_ = 0;
  bool running_ = false, stepped_ = false;  // stepped: since it began
  rclcpp::Subscription<sensor_msgs::msg::Imu>::SharedPtr imu_;
  rclcpp::Subscription<sensor_msgs::msg::NavSatFix>::SharedPtr gnss_;
  rclcpp::Subscription<geometry_msgs::msg::TwistWithCovarianceStamped>::SharedPtr velocity_;
  rclcpp::Publisher<nav_msgs::msg::Odometry>::SharedPtr odometry_;

  void fix(const sensor_msgs::msg::NavSatFix& m) {
    if (m.status.status < 0) return;
    fix_t_ = rclcpp::Time(m.header.stamp).seconds();
    const double* c = m.position_covariance.data();  // East-North-Up
    const bool known = m.position_covariance_type > 0;
    fix_ = {m.latitude, m.longitude, m.altitude, NAN, NAN, NAN,
            known ? std::sqrt(c[4]) : NAN, known ? std::sqrt(c[0]) : NAN, known ? std::sqrt(c[8]) : NAN,
            NAN, NAN, NAN, 1, 0};
    offer();
  }

  bool together() const { return std::abs(velocity_t_ - fix_t_) < TOGETHER_S; }

  void offer() {  // the last fix to its epoch: the open one, or the one before it
    if (together()) std::copy_n(v_ned_.begin(), 3, fix_.begin() + 3);
    const bool late = fix_t_ <= end_ + ON_BOUNDARY_S;
    if (!late) fixes_[W + 1] = fix_;
    else if (at(fixes_[W], fix_)) advance();
  }

  bool at(std::array<double, DLKF_FIX>& boundary, const std::array<double, DLKF_FIX>& fix) {  // at end_
    const double lag = end_ - fix_t_;
    if (lag > EPOCH_S - ON_BOUNDARY_S) return false;
    boundary = fix;
    boundary[DLKF_FIX_LAG_S] = lag <= ON_BOUNDARY_S ? 0 : lag;
    return true;
  }

  void imu(const sensor_msgs::msg::Imu& m) {
    const auto &a = m.linear_acceleration, &w = m.angular_velocity;
    const double sample[6] = {a.x, -a.y, -a.z, w.x, -w.y, -w.z};
    std::memcpy(samples_[W][count_], sample, sizeof sample);
    if (++count_ < DLKF_SAMPLES) return;
    count_ = 0;
    end_ = rclcpp::Time(m.header.stamp).seconds();
    std::memmove(samples_[0], samples_[1], sizeof samples_[0] * W);
    std::move(fixes_.begin() + 1, fixes_.end(), fixes_.begin());
    if (!std::isnan(fixes_[W][0]) && !at(fixes_[W], fixes_[W])) fixes_[W].fill(NAN);
    fixes_[W + 1].fill(NAN);
    stepped_ = running_;
    if (running_) std::memcpy(memory_[0], memory_[1], sizeof memory_[0]);
    advance();
    if (stepped_) publish(m.header.stamp, row_);
  }

  void advance() {  // to end_: the last epoch from memory_[0] to memory_[1], or the beginning
    if (stepped_) {
      dlkf_step(memory_[0], samples_[W - 1][0], fixes_[W].data(), memory_[1], row_);
      if (row_[DLKF_FROM_ORIGIN_M] <= DLKF_ANCHOR_M) return;
      std::memcpy(moved_, memory_[1], sizeof moved_);
      dlkf_anchor(moved_, memory_[1]);
    } else {
      double ready;
      dlkf_begin(samples_[0][0], fixes_[0].data(), arm_.data(), memory_[1], &ready);
      running_ = ready > 0;
    }
  }

  void publish(const builtin_interfaces::msg::Time& stamp, const double* row) {
    nav_msgs::msg::Odometry out;  // x, y, z hold longitude, latitude [deg] and height [m]; axes East-North-Up
    out.header.stamp = stamp;
    out.header.frame_id = "earth";
    out.pose.pose.position.x = row[DLKF_LON_DEG];
    out.pose.pose.position.y = row[DLKF_LAT_DEG];
    out.pose.pose.position.z = row[DLKF_HEIGHT_M];
    const double r = row[DLKF_ROLL] / 2, p = -row[DLKF_PITCH] / 2, y = (M_PI / 2 - row[DLKF_YAW]) / 2;
    auto& q = out.pose.pose.orientation;
    q.w = std::cos(r) * std::cos(p) * std::cos(y) + std::sin(r) * std::sin(p) * std::sin(y);
    q.x = std::sin(r) * std::cos(p) * std::cos(y) - std::cos(r) * std::sin(p) * std::sin(y);
    q.y = std::cos(r) * std::sin(p) * std::cos(y) + std::sin(r) * std::cos(p) * std::sin(y);
    q.z = std::cos(r) * std::cos(p) * std::sin(y) - std::sin(r) * std::sin(p) * std::cos(y);
    out.twist.twist.linear.x = row[DLKF_VEL_E];
    out.twist.twist.linear.y = row[DLKF_VEL_N];
    out.twist.twist.linear.z = -row[DLKF_VEL_D];
    odometry_->publish(out);
  }
};

int main(int argc, char** argv) {
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<DlkfNode>());
  rclcpp::shutdown();
}
