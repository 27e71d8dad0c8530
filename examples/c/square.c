/* Flies drone1 along a 2 m square in the lockstep, with its own position controller, and lands.

       gcc -std=c99 -O2 -I clients/c examples/c/square.c clients/c/zsim.c -lm -o square
       ./square [HOST [PORT]]

   Simulated time waits for this program at every gate, so it may be slow, or stopped in a debugger. */
#include "zsim.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#define DRONE "drone/drone1"
#define PERIOD_S 0.02 /* period of the controller, a multiple of the gate period */
#define GAIN_1_S 0.8 /* speed per metre of error */
#define SPEED_M_S 0.8 /* maximum on each axis */
#define NEAR_M 0.25 /* distance at which a corner counts as reached; the estimate is not more accurate */
#define LEG_S 8.0 /* maximum time for a corner; then the drone flies to the next one */

static const double corners[][3] = {{0, 0, 1.5}, {2, 0, 1.5}, {2, 2, 1.5}, {0, 2, 1.5}, {0, 0, 1.5}}; /* from its start */
enum { CORNERS = sizeof corners / sizeof corners[0] };

typedef struct {
    double start[3]; /* estimated position before take-off [m; W] */
    int started, corner, landing;
    double since_s; /* start of the flight to this corner */
} flight;

static int stop(const zsim_client *c)
{
    fprintf(stderr, "%s\n", c->error);
    return 1;
}

static double limited(double value, double limit)
{
    return fmax(-limit, fmin(limit, value));
}

/* Set the velocity [m/s; W] towards the current corner; return its distance [m]. */
static double steer(const flight *f, const double p[3], double v[3])
{
    double far_m2 = 0;
    for (int i = 0; i < 3; i++) {
        double error_m = corners[f->corner][i] + f->start[i] * (i < 2) - p[i];
        v[i] = limited(GAIN_1_S * error_m, SPEED_M_S);
        far_m2 += error_m * error_m;
    }
    return sqrt(far_m2);
}

/* Fly to the current corner, to the next one once it is reached, and land after the last one. */
static void fly(zsim_client *c, flight *f, const double p[3])
{
    double v[3], now_s = 1e-9 * (double)c->t_ns, far_m = steer(f, p, v);
    if (far_m < NEAR_M || now_s - f->since_s > LEG_S) {
        printf("t = %5.2f s  corner %d  at %5.2f %5.2f %5.2f m, %.2f m away\n", now_s, f->corner, p[0], p[1], p[2], far_m);
        f->since_s = now_s;
        f->landing = ++f->corner == CORNERS;
    }
    if (f->landing)
        zsim_mode(c, "drone1", "land");
    else
        zsim_velocity(c, "drone1", v, 0.0, "world");
}

/* Send the commands of one gate; return 0 once the drone has landed. */
static int step(zsim_client *c, flight *f)
{
    zsim_json status = zsim_input(c, DRONE "/sensor/status");
    double p[3];
    if (!zsim_numbers(zsim_input(c, DRONE "/estimate"), "position_m", p, 3))
        return 1;
    if (zsim_is(status, "state", "landed")) {
        if (f->landing)
            return 0;
        for (int i = 0; i < 3; i++)
            f->start[i] = p[i];
        zsim_mode(c, "drone1", "takeoff");
    } else if (!f->landing && (zsim_is(status, "state", "hovering") || zsim_is(status, "state", "flying"))) {
        if (!f->started++)
            f->since_s = 1e-9 * (double)c->t_ns;
        fly(c, f, p);
    }
    return 1;
}

int main(int count, char **arguments)
{
    zsim_client c;
    flight f = {{0, 0, 0}, 0, 0, 0, 0.0};
    int came = 0, flying = 1;
    if (zsim_connect(&c, count > 1 ? arguments[1] : "127.0.0.1", count > 2 ? atoi(arguments[2]) : ZSIM_PORT, "square", NULL,
                     30.0) < 0)
        return stop(&c);
    if (zsim_join(&c, "square", PERIOD_S, DRONE "/estimate " DRONE "/sensor/status", NULL) < 0)
        return stop(&c);
    while (flying && (came = zsim_gate(&c, 60.0)) > 0) {
        flying = step(&c, &f);
        if (zsim_done(&c) < 0)
            return stop(&c);
    }
    if (came <= 0)
        return came == 0 ? (fprintf(stderr, "no gate within 60 s\n"), 1) : stop(&c);
    printf("landed at t = %.2f s\n", 1e-9 * (double)c.t_ns);
    zsim_close(&c);
    return 0;
}
