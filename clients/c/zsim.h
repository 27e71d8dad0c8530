/* The client of `zsim gateway` for C: one header, one file, no dependency.

   C99 with POSIX sockets, or Winsock. Memory is taken once, in zsim_connect; nothing is allocated afterwards.
   A client belongs to one thread. docs/clients-c.md has a first program, docs/gateway.md what goes over the wire.

       zsim_client c;
       double p_WB[3];
       if (zsim_connect(&c, "127.0.0.1", ZSIM_PORT, "laptop", NULL, 5.0) < 0) { puts(c.error); return 1; }
       zsim_join(&c, "square", 0.02, "drone/drone1/estimate drone/drone1/sensor/status", NULL);
       while (zsim_gate(&c, 10.0) > 0) {
           zsim_numbers(zsim_input(&c, "drone/drone1/estimate"), "position_m", p_WB, 3);
           zsim_mode(&c, "drone1", "takeoff");
           zsim_done(&c);
       }
       zsim_close(&c);

   What functions with a client return: 1 done, 0 nothing came in time, -1 failed, and `error` says why in one line.
   Units are SI and radians, times `t_ns` simulated nanoseconds, frames those of docs/conventions.md. */
#ifndef ZSIM_H
#define ZSIM_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define ZSIM_PORT 7470 /* of `zsim gateway`: lines */
#define ZSIM_KEY_MAX 512 /* bytes of a key, its end included */
#define ZSIM_ERROR_MAX 512 /* bytes of an error, its end included */
#ifndef ZSIM_LINE_MAX
#define ZSIM_LINE_MAX 4194304 /* bytes of what is received; the gateway keeps 4 MB for a client */
#endif
#ifndef ZSIM_REQUEST_MAX
#define ZSIM_REQUEST_MAX 1000000 /* bytes of a request: the gateway's limit */
#endif

/* JSON, read where it stands. A piece of text; length 0 is "there is none". Every reader takes any bytes. */
typedef struct {
    const char *text;
    size_t length;
} zsim_json;

/* The value in a text; none if the text is no JSON, or has more than 64 levels. */
zsim_json zsim_parse(const char *text, size_t length);

/* The value at a path such as "inputs.0.value.position_m"; "" is the value itself. */
zsim_json zsim_get(zsim_json value, const char *path);

/* These return 1 and set what they read, or return 0 and leave it: not there, of another type, or out of range. */
int zsim_number(zsim_json value, const char *path, double *number);
int zsim_numbers(zsim_json value, const char *path, double *numbers, size_t count); /* a list of exactly so many */
int zsim_integer(zsim_json value, const char *path, int64_t *number);
int zsim_text(zsim_json value, const char *path, char *text, size_t size); /* UTF-8; what C cannot hold is U+FFFD */

/* Tell whether there is this text, or `true`, at a path. */
int zsim_is(zsim_json value, const char *path, const char *text);
int zsim_is_true(zsim_json value, const char *path);

/* Go through a list or a map: 1 and the next entry, until 0. `at` begins with 0; `name` is a JSON text, none in lists. */
int zsim_each(zsim_json value, size_t *at, zsim_json *name, zsim_json *entry);

/* Write a number so that it reads back as the same bits, whatever the locale; 0 if it is not finite. */
int zsim_format(double number, char text[32]);

struct zsim_inside;

typedef struct {
    char name[64]; /* who it is, such as client.laptop */
    char run_id[64];
    char mode[16]; /* lockstep or realtime */
    double gate_s; /* the grid of time */
    int64_t t_ns; /* of the gate that came last; before the first, of the newest when it connected */
    zsim_json info; /* all of the gateway's hello: drones, clusters, ... */
    zsim_json inputs; /* of the gate: list of {"key", "value"}; valid until the next zsim_gate */
    zsim_json answer; /* to zsim_latest and zsim_ask; valid until the next call that waits */
    uint64_t lost; /* values that came faster than they were read, and went */
    char error[ZSIM_ERROR_MAX];
    struct zsim_inside *inside;
} zsim_client;

/* Connect and say hello. Waits `timeout_s` for the gateway and for a run; so long at most, later, for an answer,
   but 1 s at least.
   `name` without a dot becomes client.NAME; `token` is NULL where none is asked for. On -1 there is nothing to close. */
int zsim_connect(zsim_client *c, const char *host, int port, const char *name, const char *token, double timeout_s);

/* Ask for `name`, `run_id`, `mode`, `gate_s` and `info` again: another run began. 0 if none goes on. */
int zsim_hello(zsim_client *c);

/* Leave and hang up; of a client that is closed already, nothing. */
void zsim_close(zsim_client *c);

/* Values. Keys may have wildcards in subscribe, unsubscribe and latest. */
typedef struct {
    char key[ZSIM_KEY_MAX]; /* empty if it is longer */
    zsim_json value; /* valid until the next call that waits */
} zsim_value;

int zsim_subscribe(zsim_client *c, const char *key);
int zsim_unsubscribe(zsim_client *c, const char *key);

/* The next value of what is subscribed to. -1 also when a run ends, or what was said without waiting was refused. */
int zsim_next(zsim_client *c, zsim_value *value, double timeout_s);

/* The last value of a key, 0 if there is none; `answer` has all that an expression takes, under "values". */
int zsim_latest(zsim_client *c, const char *key, zsim_json *value);

/* Ask the world or a controller: zsim_ask(c, "world/control", "pause", NULL). `args` is a JSON map or NULL.
   1: granted, `answer` has "result". -1: refused, or nobody answers. */
int zsim_ask(zsim_client *c, const char *key, const char *request, const char *args);

/* Speak. Inside a gate all this waits for zsim_done and is stamped with the gate; elsewhere it goes at once.
   t_ns, seq and source are filled in.
   velocity_m_s [3]; `frame` is "heading" (the default, for NULL: x forward, y left, z up) or "world".
   zsim_velocity does not wait for an answer: the next call that waits tells if the gateway refused it. */
int zsim_velocity(zsim_client *c, const char *drone, const double velocity_m_s[3], double yaw_rate_rad_s,
                  const char *frame);
int zsim_mode(zsim_client *c, const char *drone, const char *mode); /* takeoff, land, emergency, reset */
int zsim_put(zsim_client *c, const char *key, const char *json);

/* The same, field by field:
       zsim_put_begin(&c, "drone/drone1/cmd/attitude");
       zsim_add_numbers(&c, "orientation_wxyz", q_WB, 4);
       zsim_add_number(&c, "thrust_n", 4.2);
       zsim_put_end(&c);   -1 if any of it was wrong */
void zsim_put_begin(zsim_client *c, const char *key);
void zsim_add_number(zsim_client *c, const char *name, double number);
void zsim_add_numbers(zsim_client *c, const char *name, const double *numbers, size_t count);
void zsim_add_integer(zsim_client *c, const char *name, int64_t number);
void zsim_add_text(zsim_client *c, const char *name, const char *text);
void zsim_add_json(zsim_client *c, const char *name, const char *json);
int zsim_put_end(zsim_client *c);

/* A seat in the lockstep. `reads` and `gates` are key expressions with spaces between them; `gates` may be NULL.
   From here on simulated time waits for this program: answer every zsim_gate with one zsim_done. */
int zsim_join(zsim_client *c, const char *name, double period_s, const char *reads, const char *gates);

/* Wait for the next gate: sets `t_ns` and `inputs`. -1 when the seat is lost; or when the last done was refused:
   then the same gate is open again. A negative timeout waits for ever. */
int zsim_gate(zsim_client *c, double timeout_s);

/* The newest input of the gate on a key; none if there is none. */
zsim_json zsim_input(const zsim_client *c, const char *key);

int zsim_done(zsim_client *c);
int zsim_leave(zsim_client *c);

#ifdef __cplusplus
}
#endif

#endif
