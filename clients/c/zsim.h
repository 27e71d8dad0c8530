/* C client for `zsim gateway`: one header and one source file without dependencies.

   C99 with POSIX sockets or Winsock. Memory is allocated only in zsim_connect. Use a client in one thread only.
   docs/clients-c.md has a first program; docs/gateway.md describes the protocol.

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

   Functions with a client return 1 on success, 0 on a timeout or as described below, and -1 on failure, with the reason
   as one line in `error`. Units are SI and radians; times `t_ns` are simulated nanoseconds; frames are those of
   docs/conventions.md. */
#ifndef ZSIM_H
#define ZSIM_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define ZSIM_PORT 7470 /* default port of the gateway for lines */
#define ZSIM_KEY_MAX 512 /* bytes of a key, including the terminating null */
#define ZSIM_ERROR_MAX 512 /* bytes of an error, including the terminating null */
#ifndef ZSIM_LINE_MAX
#define ZSIM_LINE_MAX 4194304 /* bytes of the longest received line; the gateway buffers 4 MB per client */
#endif
#ifndef ZSIM_REQUEST_MAX
#define ZSIM_REQUEST_MAX 1000000 /* bytes of the longest request: the gateway's limit */
#endif

/* A JSON value inside a text, which is parsed in place; length 0 means no value. All readers accept any bytes. */
typedef struct {
    const char *text;
    size_t length;
} zsim_json;

/* Return the value in a text; no value if the text is not valid JSON or has more than 64 levels. */
zsim_json zsim_parse(const char *text, size_t length);

/* Return the value at a path such as "inputs.0.value.position_m"; "" means the value itself. */
zsim_json zsim_get(zsim_json value, const char *path);

/* These return 1 and set the variable. If the value is missing, of another type, or out of range, they return 0 and do
   not change it. */
int zsim_number(zsim_json value, const char *path, double *number);
int zsim_numbers(zsim_json value, const char *path, double *numbers, size_t count); /* a list of exactly `count` */
int zsim_integer(zsim_json value, const char *path, int64_t *number);
int zsim_text(zsim_json value, const char *path, char *text, size_t size); /* UTF-8; NUL, lone surrogates are U+FFFD */

/* Return whether the value at a path is this text, or `true`. */
int zsim_is(zsim_json value, const char *path, const char *text);
int zsim_is_true(zsim_json value, const char *path);

/* Iterate over a list or map: return 1 and the next entry, or 0 at the end. `*at` must be 0 before the first call; in
   maps `name` is a JSON text, in lists no value. */
int zsim_each(zsim_json value, size_t *at, zsim_json *name, zsim_json *entry);

/* Write a number such that it is read back with the same bits, in any locale; return 0 if it is not finite. */
int zsim_format(double number, char text[32]);

struct zsim_inside;

typedef struct {
    char name[64]; /* of this client, e.g. client.laptop */
    char run_id[64];
    char mode[16]; /* lockstep or realtime */
    double gate_s; /* period of the gates */
    int64_t t_ns; /* of the last gate received; before the first one, of the newest gate at the hello */
    zsim_json info; /* the gateway's complete hello: drones, clusters, ... */
    zsim_json inputs; /* of the last gate received: list of {"key", "value"}; valid until the next zsim_gate */
    zsim_json answer; /* to zsim_latest and zsim_ask; valid until the next call that waits */
    uint64_t lost; /* number of values dropped because they arrived faster than they were read */
    char error[ZSIM_ERROR_MAX];
    struct zsim_inside *inside;
} zsim_client;

/* Connect and say hello. Wait up to `timeout_s` for the gateway and a run; later calls wait that long for an answer,
   but at least 1 s. A `name` without a dot becomes client.NAME; `token` is NULL if none is required. After -1 there is
   nothing to close. */
int zsim_connect(zsim_client *c, const char *host, int port, const char *name, const char *token, double timeout_s);

/* Update `name`, `run_id`, `mode`, `gate_s`, `t_ns` and `info`, e.g. when another run has begun; return 0 if there is
   no run. */
int zsim_hello(zsim_client *c);

/* Leave the lockstep session, if any, and close the connection. Closing a client again has no effect. */
void zsim_close(zsim_client *c);

/* Values. In subscribe, unsubscribe and latest, keys may contain wildcards. */
typedef struct {
    char key[ZSIM_KEY_MAX]; /* empty if it does not fit */
    zsim_json value; /* valid until the next call that waits */
} zsim_value;

int zsim_subscribe(zsim_client *c, const char *key);
int zsim_unsubscribe(zsim_client *c, const char *key);

/* Get the next value of the subscriptions. Also return -1 when a run ends, or when a message sent without waiting was
   refused. */
int zsim_next(zsim_client *c, zsim_value *value, double timeout_s);

/* Get the last value of a key; return 0 if there is none. "values" in `answer` has those of all keys that match an
   expression. */
int zsim_latest(zsim_client *c, const char *key, zsim_json *value);

/* Send a request to the world or a controller: zsim_ask(&c, "world/control", "pause", NULL). `args` is a JSON map or
   NULL. Return 1 if it is granted, with "result" in `answer`, and -1 if it is refused or not answered. */
int zsim_ask(zsim_client *c, const char *key, const char *request, const char *args);

/* Publish. Between zsim_gate and zsim_done, messages are stamped with the gate and sent by zsim_done; at other times
   they are sent immediately. t_ns, seq and source are filled in.
   `frame` of a velocity is "heading" (x forward, y left, z up; the default, for NULL) or "world".
   zsim_velocity does not wait for an answer: if the gateway refuses the command, the next call that waits fails. */
int zsim_velocity(zsim_client *c, const char *drone, const double velocity_m_s[3], double yaw_rate_rad_s,
                  const char *frame);
int zsim_mode(zsim_client *c, const char *drone, const char *mode); /* takeoff, land, emergency, reset */
int zsim_put(zsim_client *c, const char *key, const char *json);

/* Publish a value field by field:
       zsim_put_begin(&c, "drone/drone1/cmd/attitude");
       zsim_add_numbers(&c, "orientation_wxyz", q_WB, 4);
       zsim_add_number(&c, "thrust_n", 4.2);
       zsim_put_end(&c);   returns -1 if any field was invalid */
void zsim_put_begin(zsim_client *c, const char *key);
void zsim_add_number(zsim_client *c, const char *name, double number);
void zsim_add_numbers(zsim_client *c, const char *name, const double *numbers, size_t count);
void zsim_add_integer(zsim_client *c, const char *name, int64_t number);
void zsim_add_text(zsim_client *c, const char *name, const char *text);
void zsim_add_json(zsim_client *c, const char *name, const char *json);
int zsim_put_end(zsim_client *c);

/* Start a lockstep session. `reads` and `gates` are key expressions, separated by spaces; `gates` may be NULL.
   From now on simulated time waits for this program: answer every zsim_gate with one zsim_done. */
int zsim_join(zsim_client *c, const char *name, double period_s, const char *reads, const char *gates);

/* Wait for the next gate, and set `t_ns` and `inputs`. Return -1 if the lockstep session has ended, or if the last done
   was refused; in that case the same gate is open again. A negative timeout is unlimited. */
int zsim_gate(zsim_client *c, double timeout_s);

/* Return the newest input of the gate on a key; no value if there is none. */
zsim_json zsim_input(const zsim_client *c, const char *key);

int zsim_done(zsim_client *c);
int zsim_leave(zsim_client *c);

#ifdef __cplusplus
}
#endif

#endif
