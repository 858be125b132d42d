/* A drive through an exported filter: lines of sensors in, the solution out. */
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "dlkf.h"

static const char HELP[] =
    "navigate [--arm x y z] [--samples] [--latency] < drive.csv > solution.csv\n"
    "\n"
    "One line per measurement, in order of arrival, with stamps of one clock [s]:\n"
    "  imu,t,ax,ay,az,gx,gy,gz                mean over the interval that ends at t [m/s2, rad/s], forward-right-down\n"
    "  gnss,t,lat,lon,h,vn,ve,vd,6 std,q      antenna [deg, m, m/s]; std of position and velocity; q as in NMEA GGA\n"
    "  speed,t,v[,std]                        wheel speed [m/s], forward positive or never negative\n"
    "  heading,t,yaw[,std]                    of a dual-antenna receiver [rad], from North over East\n"
    "  baro,t,h[,std] or pressure,t,p[,std]   barometric height [m], or pressure [Pa]; 1-sigma in metres\n"
    "The last three, and user-defined sensors by name, are used if the filter was exported with them (aids=).\n"
    "Any rate, with jitter; nan or an empty field is an unknown value. Other lines are ignored and counted.\n"
    "\n"
    "  --arm x y z   IMU to antenna [m], forward-right-down; 0 0 0 if not given\n"
    "  --samples     a row for every IMU sample instead of every update interval\n"
    "  --latency     report the time per call at the end\n"
    "  --help        this\n"
    "\n"
    "The first line names the columns. A row that a late fix changes is written again, with revised = 1; the last row of\n"
    "a time is the valid one. There are no rows until the car moves under GNSS; standard error reports what is awaited.\n"
    "Exit code 0: solved; 1: output cannot be written; 2: a wrong argument, or nothing could be solved.\n";

enum { NUMBERS = 14, MICROSECONDS = 100000 };
static const char *const NAMES[] = DLKF_COLUMN_NAMES;
static dlkf filter;
static long calls[MICROSECONDS + 1], rows, slowest;

static int printed(int c) { return c <= DLKF_GNSS_USED || c > DLKF_FROM_ORIGIN_M; } /* the latter are of sensors */

static void print(const double *row) {
  printf("%.9f,%d", row[DLKF_T], row[DLKF_REVISED] > 0);
  for (int c = DLKF_LAT_DEG; c < DLKF_COLUMNS; c++)
    if (printed(c)) printf(",%.12g", row[c]);
  putchar('\n');
  rows++;
}

/* The numbers of a line after its first word; -1 for one that is none. */
static int numbers(const char *line, double *x) {
  int n = 0;
  for (const char *word = strchr(line, ','); word; n++) {
    char *end;
    if (n == NUMBERS) return -1;
    x[n] = strtod(++word, &end);
    if (end == word) x[n] = NAN;
    end += strspn(end, " \t\r\n");
    if (*end != ',' && *end) return -1;
    word = *end ? end : NULL;
  }
  return n;
}

static int number(const char *word, double *x) {
  char *end;
  *x = strtod(word, &end);
  return end != word && !*end && isfinite(*x);
}

/* The number of a further sensor by the first word of a line; -1: not in this filter, -2: no sensor. */
static int sensor(const char *line) {
  static const char *const known[] = {"speed", "heading", "baro", "pressure"};
  char name[32] = "";
  const size_t length = strcspn(line, ",");
  if (length < sizeof name) memcpy(name, line, length);
  const int number = dlkf_sensor(strcmp(name, "pressure") ? name : "baro");
  if (number >= 0) return number;
  for (unsigned k = 0; k < sizeof known / sizeof *known; k++)
    if (!strcmp(name, known[k])) return -1;
  return -2;
}

static void say_waiting(double t) {
  static dlkf_waiting last = DLKF_RUNS;
  static double since = -INFINITY;
  const dlkf_waiting now = dlkf_waits(&filter);
  if (now == last && (now == DLKF_RUNS || fabs(t - since) < 30)) return;
  if (now != DLKF_RUNS) fprintf(stderr, "t = %.3f: waiting for %s\n", t, dlkf_waits_for(now));
  else fprintf(stderr, "t = %.3f: aligned\n", t);
  last = now;
  since = t;
}

static void quantiles(void) {
  long all = 0, sum = 0, p50 = -1, p99 = -1;
  for (long k = 0; k <= MICROSECONDS; k++) all += calls[k];
  for (long k = 0; k <= MICROSECONDS; k++) {
    sum += calls[k];
    if (p50 < 0 && 2 * sum >= all) p50 = k;
    if (p99 < 0 && 100 * sum >= 99 * all) p99 = k;
  }
  if (all) fprintf(stderr, "%ld calls with a row, ms: p50 %.3f p99 %.3f; slowest call of all %.3f\n", all, 1e-3 * (double)p50, 1e-3 * (double)p99, 1e-3 * (double)slowest);
}

int main(int argc, char **argv) {
  double arm[3] = {0, 0, 0}, x[NUMBERS], pose[DLKF_COLUMNS];
  int timing = 0, samples = 0;
  for (int k = 1; k < argc; k++) {
    if (!strcmp(argv[k], "--help")) return fputs(HELP, stdout) < 0;
    if (!strcmp(argv[k], "--latency")) timing = 1;
    else if (!strcmp(argv[k], "--samples")) samples = 1;
    else if (!strcmp(argv[k], "--arm") && k + 3 < argc && number(argv[k + 1], arm) && number(argv[k + 2], arm + 1) && number(argv[k + 3], arm + 2)) k += 3;
    else {
      fprintf(stderr, "navigate: %s: take [--arm x y z, in metres] [--samples] [--latency] [--help]\n", argv[k]);
      return 2;
    }
  }
  dlkf_open(&filter, arm);
  for (int c = 0; c < DLKF_COLUMNS; c++)
    if (printed(c)) printf("%s%s", c ? "," : "", NAMES[c]);
  putchar('\n');
  char line[1024];
  long lines = 0, strange = 0, stamps = 0, taken = 0;
  double along_z = 0;
  while (fgets(line, sizeof line, stdin)) {
    const size_t length = strlen(line);
    int whole = feof(stdin) || (length && line[length - 1] == '\n');
    for (int c = 0; !whole && c != EOF && c != '\n';) c = getchar();
    lines++;
    const int n = whole ? numbers(line, x) : -1;
    const clock_t began = clock();
    const int imu = !strncmp(line, "imu,", 4) && n == 7;
    dlkf_status status;
    stamps += imu;
    if (imu) status = dlkf_imu(&filter, x[0], x + 1, x + 4), along_z += status == DLKF_TAKEN ? x[3] : 0, taken += status == DLKF_TAKEN;
    else if (!strncmp(line, "gnss,", 5) && n == 14) status = dlkf_gnss(&filter, x[0], x[1], x[2], x[3], x + 4, x + 7, x[13] >= 0 && x[13] < 100 ? (int)x[13] : -1);
    else if ((n == 2 || n == 3) && sensor(line) > -2) status = dlkf_aid(&filter, sensor(line), x[0], strncmp(line, "pressure,", 9) ? x[1] : dlkf_pressure_height(x[1]), n == 3 ? x[2] : (double)NAN);
    else {
      if (!strange++) {
        fprintf(stderr, "navigate: line %ld is not a measurement and is ignored: %.*s\n", lines, (int)(strcspn(line, "\n") < 60 ? strcspn(line, "\n") : 60), line);
        if (!strncmp(line, "gnss,", 5) && n >= 0) fprintf(stderr, "navigate: a fix has 14 values, this line has %d; write nan where one is unknown\n", n);
      }
      continue;
    }
    if (timing) {
      const long took = (long)(1e6 * (double)(clock() - began) / CLOCKS_PER_SEC);
      if (filter.made) calls[took < MICROSECONDS ? took : MICROSECONDS]++;
      if (took > slowest) slowest = took;
    }
    if (status == DLKF_RESTARTED) fprintf(stderr, "t = %.3f: %s\n", x[0], dlkf_says(status));
    if (status == DLKF_TAKEN && imu) say_waiting(x[0]);
    for (const double *row; (row = dlkf_next(&filter));)
      if (!samples || row[DLKF_REVISED] > 0) print(row);
    if (samples && imu && status == DLKF_TAKEN && dlkf_pose(&filter, pose) == DLKF_RUNS) print(pose);
  }
  dlkf_finish(&filter);
  for (const double *row; (row = dlkf_next(&filter));) print(row);
  for (int k = DLKF_TAKEN + 1; k < DLKF_STATUSES; k++)
    if (dlkf_count(&filter, (dlkf_status)k)) fprintf(stderr, "%lld x %s\n", (long long)dlkf_count(&filter, (dlkf_status)k), dlkf_says((dlkf_status)k));
  if (strange) fprintf(stderr, "%ld lines ignored\n", strange);
  if (timing) quantiles();
  if (!rows) fprintf(stderr, "navigate: nothing solved, waiting for %s\n", dlkf_waits_for(dlkf_waits(&filter)));
  if (2 * dlkf_count(&filter, DLKF_GAP) > stamps) fprintf(stderr, "navigate: most samples of the IMU come after a gap: are the stamps in seconds?\n");
  if (taken && !(along_z / (double)taken > -13 && along_z / (double)taken < -7)) fprintf(stderr, "navigate: az is %.2f m/s2 in the mean, must be near -9.8: are accelerations in m/s2, and axes forward-right-down?\n", along_z / (double)taken);
  if (fflush(stdout) || ferror(stdout)) return fprintf(stderr, "navigate: %s\n", strerror(errno)), 1;
  return rows ? 0 : 2;
}
