// A drive through an exported filter: lines of IMU and GNSS in, the solution out.
//   ./navigate [--arm x y z] [--latency] < drive.csv > solution.csv
//   imu,t,accel x y z [m/s2],gyro x y z [rad/s]          at DLKF_RATE_HZ, forward-right-down, t at the interval's end
//   gnss,t,lat,lon [deg],height [m],vel n e d [m/s],std of all six,quality (NMEA GGA)      nan where unknown
//
// Fixes may come late by up to HISTORY epochs: the filter goes back and comes again. Memory is fixed before it starts.
// Exit code 2: a wrong argument, or no epoch could be solved.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "step.h"

constexpr int HISTORY = 10, FIX_NUMBERS = 14;  // t and what a line of a fix holds
constexpr int RING = HISTORY + DLKF_BEGIN_EPOCHS + 2;  // an alignment that a late fix allows looks back further
constexpr double EPOCH_S = DLKF_SAMPLES / DLKF_RATE_HZ, ON_BOUNDARY_S = 1e-3;
struct Epoch {
  double memory[DLKF_MEMORY], imu[DLKF_SAMPLES * 6], fix[DLKF_FIX], fix_t;  // memory before it
};

class Navigator {
 public:
  double lever_arm_b[3] = {0, 0, 0};
  bool timing = false;
  long epochs = 0;  // solved
  std::vector<double> milliseconds;

  void imu(double t, const double* sample) {
    latest_ = t;
    if (std::isnan(start_) || t - start_ < 0.5 / DLKF_RATE_HZ) return;  // before the grid, which the first fix lays
    Epoch& open = at(closed_);
    std::memcpy(open.imu + 6 * samples_, sample, 6 * sizeof(double));
    if (std::abs(t - start_ - (samples_ + 1) / DLKF_RATE_HZ) > 0.5 / DLKF_RATE_HZ) return restart("samples are missing, or come at another rate than DLKF_RATE_HZ", t);
    if (++samples_ == DLKF_SAMPLES) close();
  }

  void gnss(const double* line) {  // t, then DLKF_FIX - 1 numbers
    if (std::isnan(start_)) {
      start_ = line[0] + EPOCH_S * std::max(0.0, std::ceil((latest_ - line[0]) / EPOCH_S));
      for (Epoch* epoch : {&before_, &at(closed_)}) none(*epoch);
      if (start_ - line[0] < EPOCH_S) keep(before_, line, start_);
      return;
    }
    const long late = 1 - (long)std::ceil((line[0] - start_ - ON_BOUNDARY_S) / EPOCH_S);  // epochs
    if (late < 0 || late > std::min<long>(HISTORY, closed_)) return;
    Epoch& epoch = at(closed_ - late);
    if (epoch.fix_t >= line[0]) return;
    keep(epoch, line, start_ + (1 - late) * EPOCH_S);
    const bool again = running_ && closed_ - late >= first_;
    if (late && !running_) begin(closed_ - late + 1);
    if (late && running_ && (again || first_ == closed_ - late + 1))
      for (long k = again ? closed_ - late : first_; k < closed_; k++) step(k);
  }

 private:
  Epoch ring_[RING], before_;
  double memory_[DLKF_MEMORY], start_ = NAN, latest_ = -INFINITY;  // of the open epoch; of the samples
  long closed_ = 0, first_ = 0;
  int samples_ = 0;
  bool running_ = false;

  Epoch& at(long k) { return ring_[k % RING]; }
  void none(Epoch& epoch) {
    std::fill_n(epoch.fix, DLKF_FIX, NAN);
    epoch.fix_t = -INFINITY;
  }
  void keep(Epoch& epoch, const double* line, double end) {
    std::copy_n(line + 1, DLKF_FIX - 1, epoch.fix);
    const double lag = end - line[0];
    epoch.fix[DLKF_FIX_LAG_S] = lag <= ON_BOUNDARY_S ? 0 : lag;
    epoch.fix_t = line[0];
  }
  void restart(const char* why, double t) {
    std::fprintf(stderr, "%s at t = %.3f: starting over\n", why, t);
    start_ = NAN;
    closed_ = samples_ = running_ = 0;
  }

  void close() {
    start_ += EPOCH_S;
    samples_ = 0;
    if (!running_) begin(closed_);
    closed_++;
    if (running_) step(closed_ - 1);
    none(at(closed_));
  }

  void begin(long k0) {  // at the start of an epoch
    static double imu[DLKF_BEGIN_EPOCHS][DLKF_SAMPLES * 6], fixes[DLKF_BEGIN_EPOCHS + 1][DLKF_FIX];
    const long from = k0 - DLKF_BEGIN_EPOCHS;
    if (from < 0) return;
    for (int k = 0; k < DLKF_BEGIN_EPOCHS; k++) std::memcpy(imu[k], at(from + k).imu, sizeof imu[k]);
    for (int k = 0; k <= DLKF_BEGIN_EPOCHS; k++) std::memcpy(fixes[k], (from + k ? at(from + k - 1) : before_).fix, sizeof fixes[k]);
    double ready;
    dlkf_begin(imu[0], fixes[0], lever_arm_b, memory_, &ready);
    first_ = k0;
    if ((running_ = ready > 0)) std::memcpy(at(k0).memory, memory_, sizeof memory_);
  }

  void step(long k) {
    Epoch& epoch = at(k);
    double row[DLKF_ROW];
    const auto began = std::chrono::steady_clock::now();
    dlkf_step(epoch.memory, epoch.imu, epoch.fix, memory_, row);
    if (timing) milliseconds.push_back(std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - began).count());
    epochs++;
    double* next = at(k + 1).memory;
    if (row[DLKF_FROM_ORIGIN_M] > DLKF_ANCHOR_M) dlkf_anchor(memory_, next);
    else std::memcpy(next, memory_, sizeof memory_);
    std::printf("%.9f", start_ - (closed_ - 1 - k) * EPOCH_S);
    for (int c = 0; c <= DLKF_GNSS_USED; c++) std::printf(",%.12g%s", row[c], c < DLKF_GNSS_USED ? "" : "\n");
    if (!std::isfinite(row[DLKF_LAT_DEG])) restart("the filter diverged", start_);
  }
};

bool number(const char* word, double& x) {
  char rest;
  return std::sscanf(word, "%lf%c", &x, &rest) == 1 && std::isfinite(x);
}

int main(int argc, char** argv) {
  static Navigator navigator;
  double* arm = navigator.lever_arm_b;
  for (int k = 1; k < argc; k++) {
    if (!std::strcmp(argv[k], "--latency")) navigator.timing = true;
    else if (!std::strcmp(argv[k], "--arm") && k + 3 < argc && number(argv[k + 1], arm[0]) && number(argv[k + 2], arm[1]) && number(argv[k + 3], arm[2])) k += 3;
    else return std::fprintf(stderr, "navigate: %s: take [--arm x y z, in metres] [--latency]\n", argv[k]), 2;
  }
  char line[1024];
  double x[FIX_NUMBERS];
  bool strange = false;
  while (std::fgets(line, sizeof line, stdin)) {
    int n = 0;
    for (char* word = std::strchr(line, ','); word && n < FIX_NUMBERS; word = std::strchr(word + 1, ','))
      x[n++] = std::strtod(word + 1, nullptr);
    if (!std::strncmp(line, "imu,", 4) && n == 7) navigator.imu(x[0], x + 1);
    else if (!std::strncmp(line, "gnss,", 5) && n == FIX_NUMBERS) navigator.gnss(x);
    else if (!strange) strange = std::fprintf(stderr, "navigate: no sample and no fix, passed over like all such: %.*s\n", (int)std::strcspn(line, "\n"), line);
  }
  std::vector<double>& ms = navigator.milliseconds;
  std::sort(ms.begin(), ms.end());
  if (!ms.empty()) std::fprintf(stderr, "%zu epochs, ms: p50 %.4f p99 %.4f\n", ms.size(), ms[ms.size() / 2], ms[ms.size() * 99 / 100]);
  if (!navigator.epochs) std::fprintf(stderr, "navigate: nothing solved: the car must move under GNSS, with samples at DLKF_RATE_HZ\n");
  return navigator.epochs ? 0 : 2;
}
