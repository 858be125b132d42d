// A ROS 2 node round an exported filter: sensor_msgs/Imu, NavSatFix with TwistWithCovarianceStamped, and of further
// sensors TwistStamped (wheel speed), QuaternionStamped (heading) and FluidPressure in, Odometry out.
//
// In a package's CMakeLists.txt, beside the folder of the export as dlkf/:
//   add_subdirectory(dlkf)
//   add_executable(dlkf_node dlkf/ros2_node.cpp)
//   ament_target_dependencies(dlkf_node rclcpp sensor_msgs geometry_msgs nav_msgs)
//   target_link_libraries(dlkf_node dlkf)
//
// imu/data is forward-left-up (REP 103), at any rate, and is turned to forward-right-down; fix_velocity is the receiver's
// velocity East-North-Up with the stamp of its fix. wheel holds the speed forward in linear.x, heading the attitude of a
// dual-antenna receiver against East-North-Up, of which the yaw counts. Without one of them in the filter it is refused. What a fix may be late by is the core's to say.
#include <array>
#include <cmath>
#include <memory>
#include <vector>

#include <geometry_msgs/msg/quaternion_stamped.hpp>
#include <geometry_msgs/msg/twist_stamped.hpp>
#include <geometry_msgs/msg/twist_with_covariance_stamped.hpp>
#include <nav_msgs/msg/odometry.hpp>
#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/fluid_pressure.hpp>
#include <sensor_msgs/msg/imu.hpp>
#include <sensor_msgs/msg/nav_sat_fix.hpp>

#include "dlkf.h"

class DlkfNode : public rclcpp::Node {
 public:
  DlkfNode() : Node("dlkf"), filter_(new dlkf) {
    const std::vector<double> arm = declare_parameter("lever_arm_b", std::vector<double>{0, 0, 0});
    dlkf_open(filter_.get(), arm.data());
    imu_ = create_subscription<sensor_msgs::msg::Imu>("imu/data", 200, [this](sensor_msgs::msg::Imu::ConstSharedPtr m) { imu(*m); });
    gnss_ = create_subscription<sensor_msgs::msg::NavSatFix>("fix", 10, [this](sensor_msgs::msg::NavSatFix::ConstSharedPtr m) {
      fix_ = *m;
      waits_ = true;
      offer();
    });
    velocity_ = create_subscription<geometry_msgs::msg::TwistWithCovarianceStamped>(
        "fix_velocity", 10, [this](geometry_msgs::msg::TwistWithCovarianceStamped::ConstSharedPtr m) {
          velocity_ned_ = *m;
          offer();
        });
    wheel_ = create_subscription<geometry_msgs::msg::TwistStamped>("wheel", 50, [this](geometry_msgs::msg::TwistStamped::ConstSharedPtr m) {
      dlkf_speed(filter_.get(), seconds(m->header.stamp), m->twist.linear.x, NAN);
    });
    heading_ = create_subscription<geometry_msgs::msg::QuaternionStamped>("heading", 10, [this](geometry_msgs::msg::QuaternionStamped::ConstSharedPtr m) {
      const auto& q = m->quaternion;  // yaw from East over North
      const double yaw = std::atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z));
      dlkf_heading(filter_.get(), seconds(m->header.stamp), M_PI / 2 - yaw, NAN);
    });
    pressure_ = create_subscription<sensor_msgs::msg::FluidPressure>("pressure", 10, [this](sensor_msgs::msg::FluidPressure::ConstSharedPtr m) {
      const double p = m->fluid_pressure, h = dlkf_pressure_height(p), std = h - dlkf_pressure_height(p + std::sqrt(m->variance));
      dlkf_baro(filter_.get(), seconds(m->header.stamp), h, std > 0 ? std : NAN);
    });
    odometry_ = create_publisher<nav_msgs::msg::Odometry>("odometry", 10);
  }

 private:
  static constexpr double TOGETHER_S = 0.02, ALONE_S = 0.5;  // stamps of a fix and its velocity; a fix waits for one
  std::unique_ptr<dlkf> filter_;
  sensor_msgs::msg::NavSatFix fix_;
  geometry_msgs::msg::TwistWithCovarianceStamped velocity_ned_;
  bool waits_ = false;  // whether the last fix has not been given to the filter
  rclcpp::Subscription<sensor_msgs::msg::Imu>::SharedPtr imu_;
  rclcpp::Subscription<sensor_msgs::msg::NavSatFix>::SharedPtr gnss_;
  rclcpp::Subscription<geometry_msgs::msg::TwistWithCovarianceStamped>::SharedPtr velocity_;
  rclcpp::Subscription<geometry_msgs::msg::TwistStamped>::SharedPtr wheel_;
  rclcpp::Subscription<geometry_msgs::msg::QuaternionStamped>::SharedPtr heading_;
  rclcpp::Subscription<sensor_msgs::msg::FluidPressure>::SharedPtr pressure_;
  rclcpp::Publisher<nav_msgs::msg::Odometry>::SharedPtr odometry_;

  static double seconds(const builtin_interfaces::msg::Time& stamp) { return rclcpp::Time(stamp).seconds(); }

  // A fix with the velocity of its own time: to the core once both are there, without one after ALONE_S.
  void offer(double now = -INFINITY) {
    const double t = seconds(fix_.header.stamp);
    const bool together = std::abs(seconds(velocity_ned_.header.stamp) - t) < TOGETHER_S;
    if (!waits_ || fix_.status.status < 0 || !(together || now - t > ALONE_S)) return;
    const auto& v = velocity_ned_.twist.twist.linear;
    const double velocity[3] = {v.y, v.x, -v.z};
    const double* c = fix_.position_covariance.data();  // East-North-Up
    const bool known = fix_.position_covariance_type > 0;
    const double std[6] = {known ? std::sqrt(c[4]) : NAN, known ? std::sqrt(c[0]) : NAN, known ? std::sqrt(c[8]) : NAN, NAN, NAN, NAN};
    dlkf_gnss(filter_.get(), t, fix_.latitude, fix_.longitude, fix_.altitude, together ? velocity : nullptr, std, 1);
    waits_ = false;
  }

  void imu(const sensor_msgs::msg::Imu& m) {
    const auto &a = m.linear_acceleration, &w = m.angular_velocity;
    const double accel[3] = {a.x, -a.y, -a.z}, gyro[3] = {w.x, -w.y, -w.z}, t = seconds(m.header.stamp);
    offer(t);
    double row[DLKF_COLUMNS];
    if (dlkf_imu(filter_.get(), t, accel, gyro) == DLKF_TAKEN && dlkf_pose(filter_.get(), row) == DLKF_RUNS) publish(m.header.stamp, row);
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
