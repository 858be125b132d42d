/* A filter in a vehicle: IMU samples, fixes and aids as they come; position, velocity and attitude at any sample.
 *
 *   static dlkf filter;                                    // all memory there is, sizeof(dlkf), no pointer in it
 *   dlkf_open(&filter, (double[]){1.0, 0.3, -1.2});        // IMU to antenna [m], forward-right-down
 *   dlkf_imu(&filter, t, accel, gyro);                     // every sample, at whatever rate and jitter
 *   dlkf_gnss(&filter, t, lat, lon, h, v_ned, std, 4);     // every fix, up to DLKF_LATE_S late
 *   dlkf_speed(&filter, t, v, NAN);                        // every wheel speed, likewise, if the filter takes any
 *   while ((row = dlkf_next(&filter))) ...                 // the update intervals that the last call closed
 *   dlkf_pose(&filter, pose);                              // the state at the last sample
 *
 * One clock for all stamps [s]. No allocation, no state but in `dlkf`, no library but the C one's mathematics. Not for
 * two threads at once on the same `dlkf`. It does what dlkf.running.streaming.StreamingFilter does, to rounding. */
#ifndef DLKF_H
#define DLKF_H

#include <stddef.h>
#include <stdint.h>

#include "step.h"

/* Sizes, whole numbers for the compiler's command line: how late a fix or an aid may come, how fast an IMU or a further sensor may be
 * for samples to be kept that long before the first fixes (a faster one is taken, and starts with fewer of them, as long
 * as those of an update interval fit), and
 * for how long a search for the heading goes on; 0: none, the course of the first motion is the heading. */
#ifndef DLKF_LATE_S
#define DLKF_LATE_S 10
#endif
#ifndef DLKF_IMU_HZ
#define DLKF_IMU_HZ 1000
#endif
#ifndef DLKF_AID_HZ
#define DLKF_AID_HZ 100
#endif
#ifndef DLKF_SEARCH_S
#define DLKF_SEARCH_S 20
#endif

#if DLKF_LATE_S < 0 || DLKF_IMU_HZ < 1 || DLKF_AID_HZ < 1 || DLKF_SEARCH_S < 0
#error DLKF_LATE_S and DLKF_SEARCH_S must be whole numbers from 0 on, DLKF_IMU_HZ and DLKF_AID_HZ from 1 on
#endif

#define DLKF_KEEP_S (DLKF_LATE_S > 6 ? DLKF_LATE_S : 6)            /* samples before the update intervals are laid */
#define DLKF_RAW (DLKF_KEEP_S * DLKF_IMU_HZ + 16)                  /* samples held */
#define DLKF_REWIND ((DLKF_LATE_S * DLKF_RATE_MILLIHZ + DLKF_SAMPLES * 1000 - 1) / (DLKF_SAMPLES * 1000) + 1)
#define DLKF_CLOSED (DLKF_REWIND + DLKF_LOOKBACK + 1)              /* update intervals held */
#define DLKF_BOUNDARIES (DLKF_CLOSED + DLKF_REWIND + 2)            /* fixes held */
#define DLKF_ROWS (DLKF_CLOSED + DLKF_KEEP_S * DLKF_RATE_MILLIHZ / (DLKF_SAMPLES * 1000) + 4) /* rows of a call at most */
#define DLKF_EARLY 200                                             /* fixes held, before that and for the screen */
#define DLKF_SENSORS (DLKF_AIDS ? DLKF_AIDS : 1)
#define DLKF_EARLY_AIDS (DLKF_AIDS ? DLKF_AIDS * DLKF_KEEP_S * DLKF_AID_HZ : 1) /* samples of further sensors, likewise */
#define DLKF_STAMPS (DLKF_AIDS ? ((DLKF_REWIND + 1) * DLKF_SAMPLES * 1000 / DLKF_RATE_MILLIHZ + 1) * DLKF_AID_HZ : 1)
                                                                   /* of a sensor, among which one that comes twice is known */
#define DLKF_SPIKE_AHEAD 2                                         /* samples after one that decide whether it is a spike */
#define DLKF_STRETCH 54                                            /* samples that such a decision takes */
#define DLKF_AFTER_GAP 5                                           /* samples after a gap that show that it is one */
#define DLKF_HEADINGS 14                                           /* of a search */

/* What became of a sample, a fix or an aid. */
typedef enum {
  DLKF_TAKEN,       /* counts from now on; a fix is stored, for the filter at the end of its update interval */
  DLKF_REPLAYED,    /* came late: the filter went back and came again; dlkf_next gives those rows anew */
  DLKF_SUPERSEDED,  /* a later one of the same update interval is there already */
  DLKF_NOT_FINITE,  /* refused: a number is NaN or infinite */
  DLKF_IMPLAUSIBLE, /* refused: beyond what an IMU of a car, or any sensor, measures */
  DLKF_DOUBLE,      /* refused: this stamp again */
  DLKF_BACK,        /* refused: the stamp lies before the last sample's */
  DLKF_GAP,         /* refused: the stamp leaps ahead by more than is interpolated; see DLKF_BRIDGED */
  DLKF_FULL,        /* refused: more samples in an update interval than DLKF_RAW holds */
  DLKF_NO_FIX,      /* refused: quality of no satellite fix, or no position */
  DLKF_OUTSIDE,     /* refused: latitude or longitude outside +-90, +-180 degrees, or a 1-sigma below 0 */
  DLKF_IMPLAUSIBLE_FIX, /* refused: no car can have come there since the last good fix, or a frozen receiver */
  DLKF_LATE,        /* refused: more than DLKF_LATE_S late */
  DLKF_AHEAD,       /* refused: ahead of the IMU; both need one clock */
  DLKF_NO_SENSOR,   /* refused: this filter takes no such sensor */
  DLKF_RESTARTED,   /* samples out of line went on for a second: everything begins anew with an alignment */
  DLKF_DIVERGED,    /* only a count: the state was not finite, so the filter aligns anew */
  DLKF_LOST,        /* only a count: far off ten good fixes in a row, or where no car can be; it aligns anew */
  DLKF_SPIKE,       /* only a count: a sample proved to be an isolated spike, and was left out */
  DLKF_FROZEN,      /* refused: all six numbers of the IMU have been the same for half a second on a moving car */
  DLKF_BRIDGED,     /* the fifth sample after a gap of at most three seconds, over which the filter is carried; it counts,
                     * and so do the four before */
  DLKF_STATUSES
} dlkf_status;

/* What it waits for before there are rows. */
typedef enum { DLKF_RUNS, DLKF_WAITS_FOR_SAMPLES, DLKF_WAITS_FOR_FIXES, DLKF_WAITS_FOR_MOTION,
               DLKF_WAITS_FOR_HEADING } dlkf_waiting;

/* Everything below is the core's own: read it, do not write it. */
typedef struct {
  double t, x[6]; /* specific force [m/s2], rate [rad/s] */
} dlkf_sample;

typedef struct {
  double t, lat_deg, lon_deg, height_m, v[3], std[6];
  int32_t quality, used; /* used: the screen takes it */
} dlkf_report; /* of a receiver */

typedef struct {
  int64_t number; /* of the boundary; -1: none */
  double t, r_e[3], v_e[3], std[6], lag;
  int32_t used[6];
} dlkf_fix;

typedef struct {
  double t, lat_deg, lon_deg, height_m, std_m, since; /* since: the first fix in a row at this place */
} dlkf_place;

typedef struct {
  dlkf_place good, other; /* the last good fix, the last that was refused */
  double others_since;
  int32_t known, count, others; /* of a good one; good ones in a row; refused ones that agree with each other */
} dlkf_screen;

typedef struct {
  double since, total; /* of fixes in a row far off the filter: time of the first, sum of how far */
  double place[3];     /* of the last fix, r_e */
  double off[3];       /* innovation of the last one of the row */
  int32_t count;
} dlkf_watch;

typedef struct {
  double imu[DLKF_SAMPLES * 6];
} dlkf_epoch;

#if DLKF_SEARCH_S > 0
typedef struct {
  double start[DLKF_START], score[DLKF_HEADINGS], own[DLKF_HEADINGS][DLKF_HEADING_OWN_COUNT];
  double doubt;      /* probability of another heading than the likeliest */
  double scatter[2]; /* of positions and velocities before, over what they claim */
  int32_t epochs, weighed;
} dlkf_search;
#endif

typedef union {
  double filter[DLKF_MEMORY];
#if DLKF_SEARCH_S > 0
  dlkf_search search;
#endif
} dlkf_state;

typedef enum { DLKF_NOTHING, DLKF_SEARCH, DLKF_FILTER } dlkf_kind; /* what is in a state */

typedef struct {
  dlkf_state state;
  dlkf_watch watch;
  double doubt;
  int32_t kind, ended; /* status with which the filter ended there: LOST, DIVERGED, or 0 */
} dlkf_before; /* an update interval: what a late fix goes back to */

typedef struct {
  int64_t number; /* of the boundary; -1: none */
  double newest, count, value, variance, lag, first, last; /* stamp; sums; largest and least lag */
} dlkf_aided; /* samples of a further sensor in an update interval */

typedef struct {
  int32_t sensor;
  double t, value, std;
} dlkf_early_aid;

typedef struct {
  double ring[DLKF_STRETCH][6]; /* the last samples, spikes among them */
  int32_t next, count;
  int32_t apart[2];  /* which of the last two jump away from a steady one */
  int32_t undecided; /* how many of the last may yet prove to be spikes */
} dlkf_spikes;

typedef struct {
  double phase_s, step_s; /* given: a moment on a boundary, usual time between samples [s]; NAN: found */
  double step, longest;   /* in force: usual, and longest that is no gap [s] */
  double t0;              /* of the grid; NAN: not laid yet */
  double astray[2];       /* first and last stamp of a run out of line; NAN: none */
  double same[6], since[2]; /* the last sample; first and last stamp of its repetitions; NAN: none */
  double usual[6], usual_s; /* mean of the last samples, and of how many seconds */
  double gap[2], missing; /* since the open update interval began: beginning and end of the gap, NAN: none; seconds */
  dlkf_sample after[DLKF_AFTER_GAP]; /* the first samples of the run out of line */
  int32_t after_count;
  int64_t epochs;         /* closed */
  int64_t until;          /* boundary at which the open update interval ends, or those with a gap together */
  int64_t spiked;         /* samples that proved to be spikes */
  dlkf_spikes spikes;
  int32_t first, count;   /* of the ring */
  dlkf_sample ring[DLKF_RAW];
} dlkf_samples;

typedef struct {
  uint32_t layout; /* of this struct: DLKF_LAYOUT, else it is not one */
  double lever_arm_b[3];
  dlkf_samples samples;
  dlkf_screen screen, screen_before; /* after the latest fix held, before the oldest */
  dlkf_watch watch;
  dlkf_report reports[DLKF_EARLY]; /* in order of arrival; with update intervals, in order of time */
  int32_t report_first, report_count;
  dlkf_fix fixes[DLKF_BOUNDARIES];
  dlkf_epoch closed[DLKF_CLOSED];
  dlkf_before before[DLKF_REWIND];
  dlkf_aided aids[DLKF_SENSORS][DLKF_BOUNDARIES];
  double stamps[DLKF_SENSORS][DLKF_STAMPS];
  int32_t stamp[DLKF_SENSORS];
  dlkf_early_aid early_aids[DLKF_EARLY_AIDS];
  int32_t early_aid, early_aid_count;
  int64_t oldest;           /* number of the oldest closed update interval held */
  int32_t kind, latest;     /* dlkf_kind of `now`, and whether there is a row */
  dlkf_state now;
  double doubt;             /* that was left when the filter began */
  double outputs[DLKF_OUTPUTS], last[DLKF_COLUMNS];
  double rows[DLKF_ROWS][DLKF_COLUMNS];
  int32_t made, given;      /* rows of the last call: all, fetched */
  int64_t counts[DLKF_STATUSES];
  double work[DLKF_WORK];
} dlkf;

#if DLKF_RAW < DLKF_SAMPLES || DLKF_KEEP_S * DLKF_RATE_MILLIHZ < DLKF_SAMPLES * 1000
#error DLKF_IMU_HZ and DLKF_LATE_S leave no room for the samples of an update interval
#endif

#if DLKF_WORK < DLKF_EARLY
#error DLKF_EARLY is more than there is room for
#endif

#define DLKF_LAYOUT ((uint32_t)(DLKF_FINGERPRINT ^ (uint32_t)sizeof(dlkf)))

#ifdef __cplusplus
extern "C" {
#endif

/* Begin. lever_arm_b [m]: IMU to antenna, forward-right-down; NULL: none. */
void dlkf_open(dlkf *d, const double *lever_arm_b);

/* Lay the update intervals where t [s] is a boundary, and take step_s [s] as the usual time between samples, instead of
 * finding both; NAN leaves one to be found. Before the first sample. */
void dlkf_lay(dlkf *d, double t, double step_s);

/* A sample: mean specific force [m/s2] and angular rate [rad/s] over the interval that ends at t, forward-right-down. */
dlkf_status dlkf_imu(dlkf *d, double t, const double accel[3], const double gyro[3]);

/* A fix of the antenna at t: degrees and metres (ellipsoid), velocity North-East-Down [m/s] or NULL, 1-sigma of position
 * n, e, d [m] and velocity [m/s] or NULL, quality as in NMEA GGA. NAN where the receiver says nothing; a
 * 1-sigma of 0 is unknown too. */
dlkf_status dlkf_gnss(dlkf *d, double t, double lat_deg, double lon_deg, double height_m, const double *velocity_ned,
                      const double *std, int quality);

/* A sample of a further sensor at t, by its number, in the unit of its table: speed [m/s], forward positive or never
 * negative; heading [rad], from North over East; baro, height [m]. 1-sigma NAN where unknown. */
dlkf_status dlkf_aid(dlkf *d, int sensor, double t, double value, double std);
dlkf_status dlkf_speed(dlkf *d, double t, double speed, double std);
dlkf_status dlkf_heading(dlkf *d, double t, double heading, double std);
dlkf_status dlkf_baro(dlkf *d, double t, double height_m, double std);

int dlkf_sensor(const char *name);             /* its number; -1: this filter takes no such sensor */
double dlkf_pressure_height(double pressure);  /* [m] of [Pa] in the standard atmosphere, for dlkf_baro */

/* The end of a log: closes an update interval that it has reached to half a sample. */
void dlkf_finish(dlkf *d);

/* Rows of the last call in order of time, DLKF_COLUMNS numbers in the order of dlkf_column; NULL after the last one.
 * row[DLKF_REVISED] is 1 where a late fix changed one that was there before. */
const double *dlkf_next(dlkf *d);

/* The state at the last sample that can be no spike, IMU error and 1-sigma of the last row. */
dlkf_waiting dlkf_pose(dlkf *d, double *row);

dlkf_waiting dlkf_waits(const dlkf *d);

/* Probability that the car faces another way than the likeliest: 1 before it moves; once there are rows, what was left. */
double dlkf_doubt(const dlkf *d);

/* How often a status was given; samples that are taken do not count. */
int64_t dlkf_count(const dlkf *d, dlkf_status status);

/* Words for a status, and for what it waits for. */
const char *dlkf_says(dlkf_status status);
const char *dlkf_waits_for(dlkf_waiting waiting);

/* sizeof(dlkf), DLKF_COLUMNS and DLKF_SEARCH_S, for callers that cannot read this header */
extern const size_t dlkf_bytes;
extern const int dlkf_columns, dlkf_search_seconds;

/* 1 where sizeof(dlkf) bytes that were stored have the layout of this header, else 0. Damage elsewhere is not detected:
 * store a checksum with them. */
int dlkf_fits(const dlkf *d);

/* Between the files of the core. */
dlkf_status dlkf_samples_take(dlkf_samples *s, double t, const double accel[3], const double gyro[3], int moves, int runs);
void dlkf_samples_clear(dlkf_samples *s);
int dlkf_samples_lost(const dlkf_samples *s);
int dlkf_samples_begin(dlkf_samples *s, const double *t_fix, int count);
int64_t dlkf_samples_closed(dlkf_samples *s, int ended, double *imu, double seconds[3]);
double dlkf_samples_latest(const dlkf_samples *s);
double dlkf_samples_settled(const dlkf_samples *s);
double dlkf_samples_boundary(const dlkf_samples *s, int64_t number);
double dlkf_samples_place(const dlkf_samples *s, double t);
dlkf_status dlkf_samples_timing(const dlkf_samples *s, double place, int least);
double dlkf_samples_open(const dlkf_samples *s, double *imu);
int dlkf_spikes_add(dlkf_spikes *s, const double *x);
const dlkf_fix *dlkf_fix_at(const dlkf *d, int64_t boundary);
void dlkf_read_fix(const dlkf *d, int64_t boundary, const double *origin_e, const double *C_en, double *out);
void dlkf_screen_clear(dlkf_screen *s);
int dlkf_screen_take(dlkf_screen *s, const dlkf_report *x);
int dlkf_lost(dlkf *d, int64_t number, const double *fix);
double dlkf_scattered(double std, const double *scatter, int velocity);
int dlkf_align(const dlkf *d, int64_t epoch, double *start, double *force_b, double *scatter);
#if DLKF_SEARCH_S > 0
int dlkf_search_begin(dlkf *d, int64_t number);
int dlkf_search_advance(dlkf *d, const double *imu, int64_t boundary);
int dlkf_search_start(dlkf *d, double *start);
#endif
void dlkf_aids_clear(dlkf *d);
void dlkf_aids_file(dlkf *d);
void dlkf_read_aids(const dlkf *d, int64_t boundary, double *out);
int dlkf_replay(dlkf *d, int64_t row);
dlkf_status dlkf_counted(dlkf *d, dlkf_status status);

#ifdef __cplusplus
}
#endif
#endif
