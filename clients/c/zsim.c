/* C client for `zsim gateway`; zsim.h describes its use.

   From top to bottom: JSON reader, JSON writer, socket, lines, requests, and the functions of zsim.h. */
#ifdef _WIN32
#define _WIN32_WINNT 0x0600 /* WSAPoll */
#else
#define _POSIX_C_SOURCE 200809L
#endif

#include "zsim.h"

#include <errno.h>
#include <inttypes.h>
#include <locale.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#include <winsock2.h>
#include <ws2tcpip.h>
typedef SOCKET socket_type;
#define NO_SOCKET INVALID_SOCKET
#define poll WSAPoll
#define close_socket closesocket
#define WOULD_BLOCK (WSAGetLastError() == WSAEWOULDBLOCK)
#define SEND_FLAGS 0
#else
#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>
typedef int socket_type;
#define NO_SOCKET (-1)
#define close_socket close
#define WOULD_BLOCK (errno == EAGAIN || errno == EWOULDBLOCK || errno == EINPROGRESS || errno == EINTR)
#ifdef MSG_NOSIGNAL
#define SEND_FLAGS MSG_NOSIGNAL /* report a closed connection as an error, not by SIGPIPE */
#else
#define SEND_FLAGS 0
#endif
#endif

/* Reading JSON in place */

enum {
    DEPTH_MAX = 64, /* levels, one bit each */
    NUMBER_MAX = 400, /* bytes; writing a double exactly can take 767 digits, but no known sender does so */
    REPLACEMENT = 0xFFFD
};

static const double ANSWER_S = 1.0; /* minimum timeout for an answer */
static const double PATIENCE_S = 3600.0; /* longest single poll, whose argument is an int of milliseconds */
static const double RETURN_S = 1.0; /* additional timeout if the gateway itself waits for an answer */

typedef struct {
    const char *at, *end;
} reader;

static reader reader_of(zsim_json json)
{
    reader in = {json.text, json.text};
    if (json.length > 0)
        in.end += json.length;
    return in;
}

static zsim_json piece(const char *from, const char *to)
{
    zsim_json found = {from, (size_t)(to - from)};
    return found;
}

static zsim_json none(void)
{
    zsim_json nothing = {NULL, 0};
    return nothing;
}

static void skip_space(reader *in)
{
    while (in->at < in->end && (*in->at == ' ' || *in->at == '\t' || *in->at == '\n' || *in->at == '\r'))
        in->at++;
}

/* Return the next character, 0 at the end. */
static char peek(const reader *in)
{
    return in->at < in->end ? *in->at : '\0';
}

static int skip_char(reader *in, char wanted)
{
    if (in->at == in->end || *in->at != wanted)
        return 0;
    in->at++;
    return 1;
}

static int is_digit(char c)
{
    return c >= '0' && c <= '9';
}

static int skip_digits(reader *in)
{
    const char *first = in->at;
    while (is_digit(peek(in)))
        in->at++;
    return in->at > first;
}

static int skip_number(reader *in)
{
    skip_char(in, '-');
    if (!skip_char(in, '0') && !skip_digits(in))
        return 0;
    if (skip_char(in, '.') && !skip_digits(in))
        return 0;
    if (!skip_char(in, 'e') && !skip_char(in, 'E'))
        return 1;
    if (!skip_char(in, '+'))
        skip_char(in, '-');
    return skip_digits(in);
}

static int hex_digit(char c)
{
    if (is_digit(c))
        return c - '0';
    if (c >= 'a' && c <= 'f')
        return c - 'a' + 10;
    return c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
}

/* Read the four digits of \uXXXX; return -1 if they are missing. */
static long read_unit(reader *in)
{
    long unit = 0;
    if (in->end - in->at < 4)
        return -1;
    for (int i = 0; i < 4; i++) {
        int digit = hex_digit(*in->at++);
        if (digit < 0)
            return -1;
        unit = unit * 16 + digit;
    }
    return unit;
}

/* Read the character after \u, including both halves of a surrogate pair; 0 and a lone surrogate become U+FFFD. Return
   -1 if the digits are not hexadecimal. */
static long read_escaped(reader *in)
{
    long first = read_unit(in), second;
    reader ahead = *in;
    if (first < 0)
        return -1;
    if (first < 0xD800 || first > 0xDFFF)
        return first ? first : REPLACEMENT;
    if (first > 0xDBFF || !skip_char(&ahead, '\\') || !skip_char(&ahead, 'u'))
        return REPLACEMENT;
    second = read_unit(&ahead);
    if (second < 0xDC00 || second > 0xDFFF)
        return REPLACEMENT;
    *in = ahead;
    return 0x10000 + ((first - 0xD800) << 10) + (second - 0xDC00);
}

static size_t encode(long point, char out[4])
{
    if (point < 0x80) {
        out[0] = (char)point;
        return 1;
    }
    if (point < 0x800) {
        out[0] = (char)(0xC0 | (point >> 6));
        out[1] = (char)(0x80 | (point & 0x3F));
        return 2;
    }
    if (point < 0x10000) {
        out[0] = (char)(0xE0 | (point >> 12));
        out[1] = (char)(0x80 | ((point >> 6) & 0x3F));
        out[2] = (char)(0x80 | (point & 0x3F));
        return 3;
    }
    out[0] = (char)(0xF0 | (point >> 18));
    out[1] = (char)(0x80 | ((point >> 12) & 0x3F));
    out[2] = (char)(0x80 | ((point >> 6) & 0x3F));
    out[3] = (char)(0x80 | (point & 0x3F));
    return 4;
}

/* Read a character of a string after its opening quote; return its number of bytes, 0 at the closing quote, -1 on a
   syntax error. */
static int read_char(reader *in, char out[4])
{
    static const char escapes[] = "\"\"\\\\//b\bf\fn\nr\rt\t"; /* pairs: the escaped and the actual character */
    long point;
    if (in->at == in->end || (unsigned char)*in->at < 0x20)
        return -1;
    out[0] = *in->at++;
    if (out[0] == '"')
        return 0;
    if (out[0] != '\\')
        return 1;
    if (skip_char(in, 'u')) {
        point = read_escaped(in);
        return point < 0 ? -1 : (int)encode(point, out);
    }
    for (const char *pair = escapes; *pair; pair += 2)
        if (skip_char(in, pair[0])) {
            out[0] = pair[1];
            return 1;
        }
    return -1;
}

static int skip_string(reader *in)
{
    char bytes[4];
    int count;
    if (!skip_char(in, '"'))
        return 0;
    while ((count = read_char(in, bytes)) > 0)
        ;
    return count == 0;
}

static int skip_word(reader *in, const char *word)
{
    size_t length = strlen(word);
    if ((size_t)(in->end - in->at) < length || memcmp(in->at, word, length) != 0)
        return 0;
    in->at += length;
    return 1;
}

static int skip_scalar(reader *in)
{
    switch (peek(in)) {
    case '"':
        return skip_string(in);
    case 't':
        return skip_word(in, "true");
    case 'f':
        return skip_word(in, "false");
    case 'n':
        return skip_word(in, "null");
    default:
        return skip_number(in);
    }
}

static int skip_name(reader *in)
{
    skip_space(in);
    if (!skip_string(in))
        return 0;
    skip_space(in);
    return skip_char(in, ':');
}

/* The open levels around a value: how many there are, and which of them are maps. */
typedef struct {
    int depth;
    uint64_t maps;
} levels;

static int in_map(const levels *open)
{
    return (int)(open->maps >> (open->depth - 1) & 1);
}

/* Enter a list or map; return 1 if a value follows, 0 if it is empty, -1 on a syntax error. */
static int enter(reader *in, levels *open)
{
    int map = *in->at++ == '{';
    if (open->depth == DEPTH_MAX)
        return -1;
    skip_space(in);
    if (skip_char(in, map ? '}' : ']'))
        return 0;
    open->maps = (open->maps & ~((uint64_t)1 << open->depth)) | (uint64_t)map << open->depth;
    open->depth++;
    return map && !skip_name(in) ? -1 : 1;
}

/* Continue after a value; return 1 if another follows, 0 if all levels are closed, -1 on a syntax error. */
static int leave_value(reader *in, levels *open)
{
    while (open->depth > 0) {
        skip_space(in);
        if (skip_char(in, ','))
            return in_map(open) && !skip_name(in) ? -1 : 1;
        if (!skip_char(in, in_map(open) ? '}' : ']'))
            return -1;
        open->depth--;
    }
    return 0;
}

/* Skip a value, without recursion, so that the input does not determine how much stack is used. */
static int skip_value(reader *in)
{
    levels open = {0, 0};
    int more = 1;
    while (more > 0) {
        skip_space(in);
        if (peek(in) == '{' || peek(in) == '[') {
            more = enter(in, &open);
            if (more != 0)
                continue;
        } else if (!skip_scalar(in)) {
            return 0;
        }
        more = leave_value(in, &open);
    }
    return more == 0;
}

static zsim_json read_value(reader *in)
{
    const char *first;
    skip_space(in);
    first = in->at;
    return skip_value(in) ? piece(first, in->at) : none();
}

zsim_json zsim_parse(const char *text, size_t length)
{
    reader in = reader_of(piece(text, text + length));
    zsim_json found = read_value(&in);
    skip_space(&in);
    return in.at == in.end ? found : none();
}

int zsim_each(zsim_json value, size_t *at, zsim_json *name, zsim_json *entry)
{
    reader in = reader_of(value);
    int map;
    skip_space(&in);
    map = peek(&in) == '{';
    if (!map && peek(&in) != '[')
        return 0;
    if (*at == 0)
        in.at++;
    else if (*at < value.length)
        in.at = value.text + *at;
    else
        return 0;
    skip_space(&in);
    if (*at != 0 && !skip_char(&in, ','))
        return 0;
    *name = none();
    if (map) {
        skip_space(&in);
        name->text = in.at;
        if (!skip_string(&in))
            return 0;
        name->length = (size_t)(in.at - name->text);
        skip_space(&in);
        if (!skip_char(&in, ':'))
            return 0;
    }
    *entry = read_value(&in);
    *at = (size_t)(in.at - value.text);
    return entry->length > 0;
}

/* Return whether a JSON text, unescaped, equals these bytes. */
static int says(zsim_json text, const char *wanted, size_t length)
{
    reader in = reader_of(text);
    char bytes[4];
    int count;
    if (!skip_char(&in, '"'))
        return 0;
    while ((count = read_char(&in, bytes)) > 0) {
        if ((size_t)count > length || memcmp(bytes, wanted, (size_t)count) != 0)
            return 0;
        wanted += count;
        length -= (size_t)count;
    }
    return count == 0 && length == 0;
}

/* Return a part of a path as a number; SIZE_MAX if it is not one. */
static size_t index_of(const char *part, size_t length)
{
    size_t number = 0;
    for (size_t i = 0; i < length; i++) {
        if (!is_digit(part[i]) || i == 9)
            return SIZE_MAX;
        number = number * 10 + (size_t)(part[i] - '0');
    }
    return length > 0 ? number : SIZE_MAX;
}

static zsim_json member(zsim_json value, const char *part, size_t length)
{
    zsim_json name, entry;
    size_t at = 0, wanted = index_of(part, length);
    for (size_t i = 0; zsim_each(value, &at, &name, &entry); i++)
        if (name.length > 0 ? says(name, part, length) : i == wanted)
            return entry;
    return none();
}

zsim_json zsim_get(zsim_json value, const char *path)
{
    reader in = reader_of(value);
    if (*path == '\0')
        return read_value(&in);
    for (;;) {
        size_t length = strcspn(path, ".");
        value = member(value, path, length);
        if (path[length] == '\0')
            return value;
        path += length + 1;
    }
}

/* Read a number with strtod, which expects the locale's decimal point. */
static int to_double(zsim_json text, double *number)
{
    const char *point = localeconv()->decimal_point;
    char digits[NUMBER_MAX + 16];
    size_t used = 0;
    double read;
    if (text.length == 0 || text.length > NUMBER_MAX || (text.text[0] != '-' && !is_digit(text.text[0])))
        return 0;
    for (size_t i = 0; i < text.length; i++) {
        if (text.text[i] != '.') {
            digits[used++] = text.text[i];
            continue;
        }
        for (const char *byte = point; *byte && used < NUMBER_MAX + 8; byte++)
            digits[used++] = *byte;
    }
    digits[used] = '\0';
    read = strtod(digits, NULL);
    if (!isfinite(read))
        return 0;
    *number = read;
    return 1;
}

int zsim_number(zsim_json value, const char *path, double *number)
{
    return to_double(zsim_get(value, path), number);
}

int zsim_numbers(zsim_json value, const char *path, double *numbers, size_t count)
{
    zsim_json list = zsim_get(value, path), name, entry;
    double ignored;
    size_t at = 0, found = 0;
    if (list.length == 0 || list.text[0] != '[')
        return 0;
    for (; zsim_each(list, &at, &name, &entry); found++)
        if (found == count || !to_double(entry, &ignored))
            return 0;
    if (found != count)
        return 0;
    at = 0;
    for (size_t i = 0; i < count && zsim_each(list, &at, &name, &entry); i++)
        to_double(entry, &numbers[i]);
    return 1;
}

int zsim_integer(zsim_json value, const char *path, int64_t *number)
{
    zsim_json text = zsim_get(value, path);
    reader in = reader_of(text);
    int negative = skip_char(&in, '-');
    int64_t read = 0; /* accumulated as a negative number, since INT64_MIN has no positive counterpart */
    if (in.at == in.end)
        return 0;
    for (; in.at < in.end; in.at++) {
        int digit = *in.at - '0';
        if (!is_digit(*in.at) || read < (INT64_MIN + digit) / 10)
            return 0;
        read = read * 10 - digit;
    }
    if (!negative && read == INT64_MIN)
        return 0;
    *number = negative ? read : -read;
    return 1;
}

int zsim_text(zsim_json value, const char *path, char *text, size_t size)
{
    zsim_json found = zsim_get(value, path);
    reader in = reader_of(found), again;
    char bytes[4];
    size_t length = 0;
    int count;
    if (!skip_char(&in, '"'))
        return 0;
    again = in;
    while ((count = read_char(&in, bytes)) > 0)
        length += (size_t)count;
    if (count < 0 || length >= size)
        return 0;
    while ((count = read_char(&again, bytes)) > 0) {
        memcpy(text, bytes, (size_t)count);
        text += count;
    }
    *text = '\0';
    return 1;
}

int zsim_is(zsim_json value, const char *path, const char *text)
{
    return says(zsim_get(value, path), text, strlen(text));
}

int zsim_is_true(zsim_json value, const char *path)
{
    zsim_json found = zsim_get(value, path);
    return found.length == 4 && memcmp(found.text, "true", 4) == 0;
}

/* Writing JSON into a buffer */

typedef struct {
    char *text;
    size_t size, length;
    int full; /* something did not fit */
} writer;

static void write_bytes(writer *out, const char *bytes, size_t count)
{
    if (count > out->size - out->length) {
        out->full = 1;
        return;
    }
    memcpy(out->text + out->length, bytes, count);
    out->length += count;
}

static void write_raw(writer *out, const char *text)
{
    write_bytes(out, text, strlen(text));
}

static void write_string(writer *out, const char *text)
{
    char escaped[8];
    write_raw(out, "\"");
    for (; *text; text++) {
        if (*text != '"' && *text != '\\' && (unsigned char)*text >= 0x20) {
            write_bytes(out, text, 1);
            continue;
        }
        snprintf(escaped, sizeof escaped, "\\u%04x", (unsigned char)*text);
        write_raw(out, escaped);
    }
    write_raw(out, "\"");
}

static void write_integer(writer *out, int64_t number)
{
    char digits[24];
    snprintf(digits, sizeof digits, "%" PRId64, number);
    write_raw(out, digits);
}

int zsim_format(double number, char text[32])
{
    char local[48]; /* at most 24 characters, plus the locale's decimal point */
    size_t used = 0;
    if (!isfinite(number))
        return 0;
    snprintf(local, sizeof local, "%.17g", number);
    for (const char *byte = local; *byte && used < 31; byte++) {
        if (is_digit(*byte) || *byte == '-' || *byte == '+' || *byte == 'e')
            text[used++] = *byte;
        else if (used > 0 && text[used - 1] != '.')
            text[used++] = '.'; /* the locale's decimal point may have several bytes */
    }
    text[used] = '\0';
    return 1;
}

static int write_number(writer *out, double number)
{
    char digits[32];
    if (!zsim_format(number, digits))
        return 0;
    write_raw(out, digits);
    return 1;
}

/* Write the user's JSON as one line; return 0 if it is invalid. */
static int write_json(writer *out, const char *json)
{
    zsim_json value = zsim_parse(json, strlen(json));
    size_t from = out->length;
    if (value.length == 0)
        return 0;
    write_bytes(out, value.text, value.length);
    for (; from < out->length; from++)
        if (out->text[from] == '\n' || out->text[from] == '\r')
            out->text[from] = ' '; /* only between values: within texts they are escaped */
    return 1;
}

/* Internal state of a client */

struct zsim_inside {
    socket_type socket;
    double timeout_s;
    int64_t id; /* of the newest request */
    int64_t done_id; /* of the newest done */
    int sits; /* has joined the lockstep */
    int open; /* a gate is not answered yet */
    int in_put; /* between put_begin and put_end */
    int faulty; /* a field of the put was invalid; `error` names it */
    size_t mark, fields; /* of the put being written: its start, and its number of fields */
    size_t first, last; /* range of the received bytes that are not taken yet */
    zsim_json line; /* the one taken last */
    writer out, said; /* the request; the outputs of the open gate */
    char *received, *taken, *gate, *info; /* ZSIM_LINE_MAX bytes each */
    char key[ZSIM_KEY_MAX]; /* of the put being written */
};

/* Write a message to `error`, as one line; return -1. */
static int fail(zsim_client *c, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(c->error, sizeof c->error, format, arguments);
    va_end(arguments);
    for (char *byte = c->error; *byte; byte++)
        if ((unsigned char)*byte < 0x20)
            *byte = ' ';
    return -1;
}

static char *part(char **memory, size_t size)
{
    char *begin = *memory;
    *memory += size;
    return begin;
}

static int take_memory(zsim_client *c)
{
    size_t size = sizeof(struct zsim_inside) + 4 * (size_t)ZSIM_LINE_MAX + 2 * (size_t)ZSIM_REQUEST_MAX;
    char *memory = malloc(size);
    if (memory == NULL)
        return fail(c, "zsim: no memory for %lu bytes; compile with smaller ZSIM_LINE_MAX", (unsigned long)size);
    c->inside = (struct zsim_inside *)(void *)part(&memory, sizeof(struct zsim_inside));
    memset(c->inside, 0, sizeof *c->inside);
    c->inside->socket = NO_SOCKET;
    c->inside->received = part(&memory, ZSIM_LINE_MAX);
    c->inside->taken = part(&memory, ZSIM_LINE_MAX);
    c->inside->gate = part(&memory, ZSIM_LINE_MAX);
    c->inside->info = part(&memory, ZSIM_LINE_MAX);
    c->inside->out.text = part(&memory, ZSIM_REQUEST_MAX);
    c->inside->said.text = part(&memory, ZSIM_REQUEST_MAX);
    c->inside->out.size = c->inside->said.size = ZSIM_REQUEST_MAX;
    return 1;
}

/* The socket */

#ifdef _WIN32
static double wall_s(void)
{
    return (double)GetTickCount64() / 1e3;
}

static int start_sockets(void)
{
    WSADATA data;
    return WSAStartup(MAKEWORD(2, 2), &data) == 0;
}

static int stop_blocking(socket_type socket)
{
    u_long on = 1;
    return ioctlsocket(socket, FIONBIO, &on) == 0;
}
#else
static double wall_s(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static int start_sockets(void)
{
    return 1;
}

static int stop_blocking(socket_type socket)
{
    return fcntl(socket, F_SETFL, O_NONBLOCK) == 0;
}
#endif

static int is_ready(socket_type socket, short events, double left_s)
{
    struct pollfd waiting;
    waiting.fd = socket;
    waiting.events = events;
    waiting.revents = 0;
    return poll(&waiting, 1, (int)ceil(1e3 * fmax(0.0, fmin(left_s, PATIENCE_S)))) > 0;
}

/* Wait until a socket can be read or written; return 0 at the deadline. A negative `until_s` means no deadline. */
static int wait_for(socket_type socket, short events, double until_s)
{
    double left_s = until_s < 0.0 ? PATIENCE_S : until_s - wall_s();
    return is_ready(socket, events, left_s) || until_s < 0.0 || wall_s() < until_s;
}

static double deadline(double timeout_s)
{
    return timeout_s < 0.0 ? -1.0 : wall_s() + timeout_s;
}

/* Open or close a gate. Messages are collected while it is open, and sent directly while none is. */
static void set_open(struct zsim_inside *in, int open)
{
    in->open = open;
    in->in_put = 0;
}

static void hang_up(struct zsim_inside *in)
{
    if (in->socket != NO_SOCKET)
        close_socket(in->socket);
    in->socket = NO_SOCKET;
    in->sits = 0;
    set_open(in, 0);
}

static int set_up(socket_type socket)
{
    int on = 1;
#ifdef SO_NOSIGPIPE
    setsockopt(socket, SOL_SOCKET, SO_NOSIGPIPE, (const char *)&on, sizeof on);
#endif
    return stop_blocking(socket) && setsockopt(socket, IPPROTO_TCP, TCP_NODELAY, (const char *)&on, sizeof on) == 0;
}

/* Return whether a pending connection has been established. */
static int is_connected(socket_type socket)
{
    int error = 1;
    socklen_t size = sizeof error;
    return getsockopt(socket, SOL_SOCKET, SO_ERROR, (char *)&error, &size) == 0 && error == 0;
}

static socket_type dial(const struct addrinfo *address, double until_s)
{
    socket_type made = socket(address->ai_family, address->ai_socktype, address->ai_protocol);
    if (made == NO_SOCKET)
        return NO_SOCKET;
    if (set_up(made)) {
        if (connect(made, address->ai_addr, (socklen_t)address->ai_addrlen) == 0)
            return made;
        if (WOULD_BLOCK && is_ready(made, POLLOUT, until_s - wall_s()) && is_connected(made))
            return made;
    }
    close_socket(made);
    return NO_SOCKET;
}

static void pause_before_dialling(void)
{
#ifdef _WIN32
    Sleep(100);
#else
    poll(NULL, 0, 100); /* ms between two attempts, while a gateway may be starting */
#endif
}

static int dial_until(zsim_client *c, const char *host, int port, double until_s)
{
    struct addrinfo hints, *found = NULL;
    char digits[16];
    memset(&hints, 0, sizeof hints);
    hints.ai_socktype = SOCK_STREAM;
    snprintf(digits, sizeof digits, "%d", port);
    if (!start_sockets() || getaddrinfo(host, digits, &hints, &found) != 0)
        return fail(c, "zsim: %.200s: no such host", host);
    for (;;) {
        for (struct addrinfo *each = found; each != NULL && c->inside->socket == NO_SOCKET; each = each->ai_next)
            c->inside->socket = dial(each, until_s);
        if (c->inside->socket != NO_SOCKET || wall_s() >= until_s)
            break;
        pause_before_dialling();
    }
    freeaddrinfo(found);
    if (c->inside->socket == NO_SOCKET)
        return fail(c, "zsim: nobody answers on %.200s:%d; start `zsim gateway` there", host, port);
    return 1;
}

static int lose(zsim_client *c, const char *why)
{
    hang_up(c->inside);
    return fail(c, "zsim: %s; close, and connect again", why);
}

static int is_up(zsim_client *c)
{
    if (c->inside != NULL && c->inside->socket != NO_SOCKET)
        return 1;
    fail(c, "zsim: there is no connection; zsim_connect makes one");
    return 0;
}

static int send_all(zsim_client *c, const char *bytes, size_t count)
{
    double until_s = deadline(c->inside->timeout_s);
    while (count > 0) {
        int sent = (int)send(c->inside->socket, bytes, count, SEND_FLAGS);
        if (sent > 0) {
            bytes += sent;
            count -= (size_t)sent;
        } else if (!WOULD_BLOCK) {
            return lose(c, "the gateway is gone");
        } else if (!wait_for(c->inside->socket, POLLOUT, until_s)) {
            return lose(c, "the gateway does not read what it is sent");
        }
    }
    return 1;
}

/* Lines: received ones are kept in order; a caller removes the one for which it waits and leaves the others in place */

enum { VALUE = 1, GATE = 2, LEFT = 4, RUN = 8, ERROR_LINE = 16, ANSWER = 32, OTHER = 64 };

static int kind_of(zsim_json line, int64_t awaited)
{
    static const struct {
        const char *op;
        int kind;
    } table[] = {{"value", VALUE}, {"gate", GATE}, {"left", LEFT}, {"run", RUN}, {"lost", OTHER}};
    int64_t id = 0;
    zsim_json op = zsim_get(line, "op");
    for (size_t i = 0; i < sizeof table / sizeof table[0]; i++)
        if (zsim_is(op, "", table[i].op))
            return table[i].kind;
    zsim_integer(line, "id", &id);
    if (awaited != 0 && id == awaited)
        return ANSWER;
    return zsim_is(op, "", "error") ? ERROR_LINE : OTHER;
}

static void remove_bytes(struct zsim_inside *in, size_t from, size_t to)
{
    if (from == in->first) {
        in->first = to;
    } else {
        memmove(in->received + from, in->received + to, in->last - to);
        in->last -= to - from;
    }
    if (in->first == in->last)
        in->first = in->last = 0;
}

/* Return the kind of a line for this client: the refusal of a done is ignored once the lockstep session has ended. */
static int kind_here(const zsim_client *c, zsim_json line, int64_t awaited)
{
    int kind = kind_of(line, awaited);
    int64_t id = 0;
    if (kind == ERROR_LINE && !c->inside->sits && zsim_integer(line, "id", &id) && id == c->inside->done_id)
        return OTHER;
    return kind;
}

/* Handle a line for which no caller waits: a notice, or a late answer, which is ignored. */
static void pass_over(zsim_client *c, zsim_json line)
{
    int64_t lost = 0;
    if (zsim_is(line, "op", "lost") && zsim_integer(line, "lines", &lost) && lost > 0)
        c->lost += (uint64_t)lost;
}

static const char *end_of_line(const struct zsim_inside *in, size_t from)
{
    return from < in->last ? memchr(in->received + from, '\n', in->last - from) : NULL;
}

static int keep(zsim_client *c, zsim_json line, int kind)
{
    struct zsim_inside *in = c->inside;
    char **where = kind == GATE ? &in->gate : &in->taken;
    memcpy(*where, line.text, line.length);
    in->line = piece(*where, *where + line.length);
    return kind;
}

/* Search the lines received from `*from` on; take the first wanted one and return its kind, 0 if there is none. */
static int take_received(zsim_client *c, int wanted, int64_t awaited, size_t *from)
{
    struct zsim_inside *in = c->inside;
    const char *end;
    while ((end = end_of_line(in, *from)) != NULL) {
        size_t next = (size_t)(end - in->received) + 1;
        zsim_json line = zsim_parse(in->received + *from, next - *from);
        int kind = kind_here(c, line, awaited);
        if (line.length == 0)
            return lose(c, "what the gateway sent is no JSON");
        if (kind & (wanted | OTHER)) {
            if (kind == OTHER)
                pass_over(c, line);
            else
                keep(c, line, kind);
            remove_bytes(in, *from, next);
            if (in->first > *from || in->last == 0)
                *from = in->first;
            if (kind != OTHER)
                return kind;
        } else {
            *from = next;
        }
    }
    return 0;
}

/* Move the received bytes to the front; if the buffer is full, drop the oldest value. Return 0 if it stays full. */
static int make_room(zsim_client *c, size_t *from)
{
    struct zsim_inside *in = c->inside;
    const char *end;
    if (in->first > 0) {
        memmove(in->received, in->received + in->first, in->last - in->first);
        *from -= in->first;
        in->last -= in->first;
        in->first = 0;
    }
    for (size_t at = 0; in->last == ZSIM_LINE_MAX && (end = end_of_line(in, at)) != NULL;) {
        size_t next = (size_t)(end - in->received) + 1;
        if (kind_of(piece(in->received + at, end), 0) != VALUE) {
            at = next;
            continue;
        }
        memmove(in->received + at, in->received + next, in->last - next);
        in->last -= next - at;
        *from -= *from >= next ? next - at : 0;
        c->lost++;
    }
    return in->last < ZSIM_LINE_MAX;
}

static int receive(zsim_client *c, size_t *from)
{
    struct zsim_inside *in = c->inside;
    int count;
    if (in->last == ZSIM_LINE_MAX && !make_room(c, from))
        return lose(c, "a line of the gateway is longer than ZSIM_LINE_MAX");
    count = (int)recv(in->socket, in->received + in->last, ZSIM_LINE_MAX - in->last, 0);
    if (count > 0) {
        in->last += (size_t)count;
        return 1;
    }
    return count < 0 && WOULD_BLOCK ? 0 : lose(c, "the gateway hung up");
}

/* Take the first line of a wanted kind; return its kind, 0 on a timeout, -1 if the connection is lost. */
static int take(zsim_client *c, int wanted, int64_t awaited, double until_s)
{
    size_t from = c->inside->first;
    for (int tries = 0;; tries++) {
        int found = take_received(c, wanted, awaited, &from), came;
        if (found != 0)
            return found;
        if (tries > 0 && until_s >= 0.0 && wall_s() > until_s)
            return 0; /* unwanted lines might otherwise extend the wait without end */
        came = receive(c, &from);
        if (came < 0)
            return came;
        if (came == 0 && !wait_for(c->inside->socket, POLLIN, until_s))
            return 0;
    }
}

/* Requests */

static void begin(zsim_client *c, const char *op)
{
    writer *out = &c->inside->out;
    if (!c->inside->open)
        c->inside->in_put = 0; /* this request overwrites the unfinished put, if any */
    out->length = 0;
    out->full = 0;
    write_raw(out, "{\"op\":\"");
    write_raw(out, op);
    write_raw(out, "\",\"id\":");
    write_integer(out, ++c->inside->id);
}

static void write_name(writer *out, const char *name)
{
    write_raw(out, ",");
    write_string(out, name);
    write_raw(out, ":");
}

static void text_field(zsim_client *c, const char *name, const char *text)
{
    write_name(&c->inside->out, name);
    write_string(&c->inside->out, text);
}

static int send_request(zsim_client *c)
{
    writer *out = &c->inside->out;
    write_raw(out, "}\n");
    if (out->full)
        return fail(c, "zsim: a request is longer than %d bytes", ZSIM_REQUEST_MAX);
    return send_all(c, out->text, out->length);
}

/* Report a refusal in `error`; after a refused done, its gate is open again. */
static int refused(zsim_client *c)
{
    char text[ZSIM_ERROR_MAX];
    zsim_json error = zsim_get(c->inside->line, "error");
    int64_t id = 0;
    if (zsim_integer(c->inside->line, "id", &id) && id == c->inside->done_id && c->inside->sits)
        set_open(c->inside, 1);
    if (error.length == 0)
        return fail(c, "zsim: the gateway refused something, and did not say why");
    if (!zsim_text(error, "", text, sizeof text)) /* too long: use its beginning */
        snprintf(text, sizeof text, "%.*s", (int)(error.length < 500 ? error.length : 500), error.text);
    return fail(c, "%s", text);
}

/* Send a request and wait for its answer. */
static int request(zsim_client *c, double timeout_s)
{
    int kind = send_request(c);
    if (kind > 0)
        kind = take(c, ANSWER | ERROR_LINE, c->inside->id, deadline(timeout_s));
    if (kind == 0)
        return fail(c, "zsim: no answer within %.1f s", timeout_s);
    if (kind < 0)
        return -1;
    return zsim_is(c->inside->line, "op", "error") ? refused(c) : 1;
}

static int request_on(zsim_client *c, const char *op, const char *key)
{
    if (!is_up(c))
        return -1;
    begin(c, op);
    text_field(c, "key", key);
    return request(c, c->inside->timeout_s);
}

/* Connecting */

/* Store the gateway's answer to hello; return 0 if there is no run. */
static int know(zsim_client *c)
{
    struct zsim_inside *in = c->inside;
    memcpy(in->info, in->line.text, in->line.length);
    c->info = piece(in->info, in->info + in->line.length);
    zsim_text(c->info, "name", c->name, sizeof c->name);
    if (!zsim_text(c->info, "run_id", c->run_id, sizeof c->run_id))
        return 0;
    if (!zsim_text(c->info, "mode", c->mode, sizeof c->mode) || !zsim_number(c->info, "gate_s", &c->gate_s) ||
        !zsim_integer(c->info, "t_ns", &c->t_ns))
        return fail(c, "zsim: hello lacks mode, gate_s or t_ns; is this a `zsim gateway` of this version?");
    return 1;
}

static int greet(zsim_client *c, const char *name, const char *token)
{
    begin(c, "hello");
    if (name != NULL)
        text_field(c, "name", name);
    if (token != NULL)
        text_field(c, "token", token);
    return request(c, c->inside->timeout_s) < 0 ? -1 : know(c);
}

static int greet_until(zsim_client *c, const char *name, const char *token, double until_s)
{
    for (;;) {
        int known = greet(c, name, token), told;
        if (known != 0)
            return known;
        told = take(c, RUN, 0, until_s);
        if (told == 0)
            return fail(c, "zsim: the gateway is there, but no run goes on; start one");
        if (told < 0)
            return -1;
    }
}

int zsim_connect(zsim_client *c, const char *host, int port, const char *name, const char *token, double timeout_s)
{
    double until_s = wall_s() + fmax(timeout_s, 0.0);
    memset(c, 0, sizeof *c);
    if (take_memory(c) < 0)
        return -1;
    c->inside->timeout_s = fmax(timeout_s, ANSWER_S);
    if (dial_until(c, host, port, until_s) > 0 && greet_until(c, name, token, until_s) > 0)
        return 1;
    zsim_close(c);
    return -1;
}

int zsim_hello(zsim_client *c)
{
    return is_up(c) ? greet(c, NULL, NULL) : -1;
}

void zsim_close(zsim_client *c)
{
    if (c->inside == NULL)
        return;
    if (c->inside->sits)
        zsim_leave(c);
    hang_up(c->inside);
    free(c->inside);
    c->inside = NULL;
    c->info = c->inputs = c->answer = none();
}

/* Values */

int zsim_subscribe(zsim_client *c, const char *key)
{
    return request_on(c, "subscribe", key);
}

int zsim_unsubscribe(zsim_client *c, const char *key)
{
    return request_on(c, "unsubscribe", key);
}

static int read_entry(zsim_client *c, zsim_value *value)
{
    value->key[0] = '\0';
    zsim_text(c->inside->line, "key", value->key, sizeof value->key);
    value->value = zsim_get(c->inside->line, "value");
    return 1;
}

int zsim_next(zsim_client *c, zsim_value *value, double timeout_s)
{
    double until_s = deadline(timeout_s);
    if (!is_up(c))
        return -1;
    for (;;) {
        int kind = take(c, VALUE | RUN | ERROR_LINE, 0, until_s);
        if (kind == VALUE)
            return read_entry(c, value);
        if (kind == ERROR_LINE)
            return refused(c);
        if (kind <= 0)
            return kind;
        if (zsim_is(c->inside->line, "state", "ended"))
            return fail(c, "zsim: the run ended; values of the next one come when it begins");
        zsim_text(c->inside->line, "run_id", c->run_id, sizeof c->run_id);
    }
}

int zsim_latest(zsim_client *c, const char *key, zsim_json *value)
{
    if (request_on(c, "latest", key) < 0)
        return -1;
    c->answer = c->inside->line;
    *value = zsim_get(c->answer, "values.0.value");
    return value->length > 0;
}

int zsim_ask(zsim_client *c, const char *key, const char *request_name, const char *args)
{
    char why[ZSIM_ERROR_MAX] = "";
    if (!is_up(c))
        return -1;
    begin(c, "ask");
    text_field(c, "key", key);
    text_field(c, "request", request_name);
    write_name(&c->inside->out, "args");
    if (!write_json(&c->inside->out, args != NULL ? args : "{}"))
        return fail(c, "zsim_ask: args is no JSON; must be a map such as {\"drone\": \"drone1\"}");
    write_name(&c->inside->out, "timeout_s");
    write_number(&c->inside->out, c->inside->timeout_s);
    if (request(c, c->inside->timeout_s + RETURN_S) < 0)
        return -1;
    c->answer = c->inside->line;
    if (zsim_is_true(c->answer, "ok"))
        return 1;
    zsim_text(c->answer, "error", why, sizeof why);
    return fail(c, "%.200s %.100s: %s", key, request_name, *why ? why : "refused");
}

/* Publishing */

static writer *target(zsim_client *c)
{
    return c->inside->open ? &c->inside->said : &c->inside->out;
}

/* Discard what a put has written. */
static int withdraw(zsim_client *c)
{
    writer *out = target(c);
    if (c->inside->open) {
        out->length = c->inside->mark;
        out->full = 0;
    }
    return -1;
}

/* Begin an output of the open gate, or a separate request if none is open. */
static writer *begin_put(zsim_client *c, const char *key)
{
    writer *out = target(c);
    if (c->inside->in_put)
        withdraw(c); /* an earlier put was not ended */
    c->inside->in_put = 0;
    c->inside->faulty = 0;
    c->inside->mark = out->length;
    snprintf(c->inside->key, sizeof c->inside->key, "%s", key);
    if (c->inside->open) {
        write_raw(out, out->length > 0 ? ",{\"key\":" : "{\"key\":");
        write_string(out, key);
    } else {
        begin(c, "put");
        text_field(c, "key", key);
    }
    write_raw(out, ",\"value\":");
    return out;
}

static int finish_put(zsim_client *c, int quiet)
{
    writer *out = target(c);
    if (c->inside->faulty)
        return withdraw(c);
    if (!c->inside->open) {
        if (quiet)
            write_raw(out, ",\"quiet\":true");
        return quiet ? send_request(c) : request(c, c->inside->timeout_s);
    }
    write_raw(out, "}");
    if (!out->full)
        return 1;
    withdraw(c);
    return fail(c, "zsim: the outputs of a gate are longer than %d bytes", ZSIM_REQUEST_MAX);
}

int zsim_put(zsim_client *c, const char *key, const char *json)
{
    if (!is_up(c))
        return -1;
    if (!write_json(begin_put(c, key), json)) {
        withdraw(c);
        return fail(c, "%.200s: what is to be put is no JSON", key);
    }
    return finish_put(c, 0);
}

void zsim_put_begin(zsim_client *c, const char *key)
{
    if (!is_up(c))
        return;
    write_raw(begin_put(c, key), "{");
    c->inside->in_put = 1;
    c->inside->fields = 0;
}

/* Begin a field; return NULL if no put has been begun. */
static writer *begin_field(zsim_client *c, const char *name)
{
    writer *out;
    if (!is_up(c) || !c->inside->in_put)
        return NULL;
    out = target(c);
    if (c->inside->fields++ > 0)
        write_raw(out, ",");
    write_string(out, name);
    write_raw(out, ":");
    return out;
}

static void blame(zsim_client *c, const char *name, const char *what)
{
    if (!c->inside->faulty)
        fail(c, "%.200s: %.100s %s", c->inside->key, name, what);
    c->inside->faulty = 1;
}

void zsim_add_number(zsim_client *c, const char *name, double number)
{
    writer *out = begin_field(c, name);
    if (out != NULL && !write_number(out, number))
        blame(c, name, "is not finite");
}

void zsim_add_numbers(zsim_client *c, const char *name, const double *numbers, size_t count)
{
    writer *out = begin_field(c, name);
    if (out == NULL)
        return;
    write_raw(out, "[");
    for (size_t i = 0; i < count; i++) {
        write_raw(out, i > 0 ? "," : "");
        if (!write_number(out, numbers[i]))
            blame(c, name, "is not finite");
    }
    write_raw(out, "]");
}

void zsim_add_integer(zsim_client *c, const char *name, int64_t number)
{
    writer *out = begin_field(c, name);
    if (out != NULL)
        write_integer(out, number);
}

void zsim_add_text(zsim_client *c, const char *name, const char *text)
{
    writer *out = begin_field(c, name);
    if (out != NULL)
        write_string(out, text);
}

void zsim_add_json(zsim_client *c, const char *name, const char *json)
{
    writer *out = begin_field(c, name);
    if (out != NULL && !write_json(out, json))
        blame(c, name, "is no JSON");
}

static int end_put(zsim_client *c, int quiet)
{
    if (!is_up(c))
        return -1;
    if (!c->inside->in_put)
        return fail(c, "zsim_put_end: nothing was begun; zsim_put_begin comes first");
    c->inside->in_put = 0;
    write_raw(target(c), "}");
    return finish_put(c, quiet);
}

int zsim_put_end(zsim_client *c)
{
    return end_put(c, 0);
}

static void begin_command(zsim_client *c, const char *drone, const char *kind)
{
    char key[128];
    snprintf(key, sizeof key, "drone/%.60s/cmd/%s", drone, kind);
    zsim_put_begin(c, key);
}

int zsim_velocity(zsim_client *c, const char *drone, const double velocity_m_s[3], double yaw_rate_rad_s,
                  const char *frame)
{
    begin_command(c, drone, "velocity");
    zsim_add_numbers(c, "velocity_m_s", velocity_m_s, 3);
    zsim_add_number(c, "yaw_rate_rad_s", yaw_rate_rad_s);
    if (frame != NULL)
        zsim_add_text(c, "frame", frame);
    return end_put(c, 1);
}

int zsim_mode(zsim_client *c, const char *drone, const char *mode)
{
    begin_command(c, drone, "mode");
    zsim_add_text(c, "mode", mode);
    return zsim_put_end(c);
}

/* The lockstep */

/* Write the words of a text as a list. */
static void list_field(zsim_client *c, const char *name, const char *words)
{
    writer *out = &c->inside->out;
    char word[ZSIM_KEY_MAX];
    int count = 0;
    write_name(out, name);
    write_raw(out, "[");
    while (*(words += strspn(words, " ")) != '\0') {
        size_t length = strcspn(words, " ");
        snprintf(word, sizeof word, "%.*s", (int)(length < sizeof word ? length : sizeof word - 1), words);
        write_raw(out, count++ > 0 ? "," : "");
        write_string(out, word);
        words += length;
    }
    write_raw(out, "]");
}

int zsim_join(zsim_client *c, const char *name, double period_s, const char *reads, const char *gates)
{
    if (!is_up(c))
        return -1;
    if (c->inside->sits)
        return fail(c, "zsim_join: is %.64s already; zsim_leave first, or use another connection", c->name);
    while (take(c, GATE | LEFT, 0, deadline(0.0)) > 0)
        ; /* lines of an earlier lockstep session */
    begin(c, "join");
    text_field(c, "name", name);
    write_name(&c->inside->out, "period_s");
    if (!write_number(&c->inside->out, period_s))
        return fail(c, "zsim_join: period_s is not finite");
    list_field(c, "reads", reads);
    if (gates != NULL)
        list_field(c, "gates", gates);
    if (request(c, c->inside->timeout_s) < 0)
        return -1;
    c->inside->sits = 1;
    zsim_text(c->inside->line, "name", c->name, sizeof c->name);
    return 1;
}

static int is_seated(zsim_client *c)
{
    if (!is_up(c))
        return 0;
    if (!c->inside->sits)
        fail(c, "zsim: there is no seat in the lockstep; zsim_join takes one");
    return c->inside->sits;
}

static int open_gate(zsim_client *c)
{
    if (!zsim_integer(c->inside->line, "t_ns", &c->t_ns))
        return lose(c, "a gate of the gateway has no t_ns");
    c->inputs = zsim_get(c->inside->line, "inputs");
    set_open(c->inside, 1);
    c->inside->said.length = 0;
    return 1;
}

static int lose_seat(zsim_client *c)
{
    char reason[ZSIM_ERROR_MAX - 32] = "";
    zsim_text(c->inside->line, "reason", reason, sizeof reason);
    c->inside->sits = 0;
    set_open(c->inside, 0);
    return fail(c, "zsim: the seat is lost: %s", reason);
}

int zsim_gate(zsim_client *c, double timeout_s)
{
    int kind;
    if (!is_seated(c))
        return -1;
    if (c->inside->open)
        return fail(c, "zsim_gate: the gate of %.3f s is open; zsim_done closes it", 1e-9 * (double)c->t_ns);
    kind = take(c, GATE | LEFT | ERROR_LINE, 0, deadline(timeout_s));
    if (kind == GATE)
        return open_gate(c);
    if (kind == LEFT)
        return lose_seat(c);
    return kind == ERROR_LINE ? refused(c) : kind;
}

zsim_json zsim_input(const zsim_client *c, const char *key)
{
    zsim_json name, entry, found = none();
    size_t at = 0;
    while (zsim_each(c->inputs, &at, &name, &entry))
        if (zsim_is(entry, "key", key))
            found = zsim_get(entry, "value");
    return found;
}

int zsim_done(zsim_client *c)
{
    writer *out;
    if (!is_seated(c))
        return -1;
    if (!c->inside->open)
        return fail(c, "zsim_done: no gate is open; zsim_gate waits for one");
    if (c->inside->in_put)
        return fail(c, "zsim_done: %.200s was begun and not ended; say zsim_put_end", c->inside->key);
    begin(c, "done");
    out = &c->inside->out;
    c->inside->done_id = c->inside->id;
    write_name(out, "t_ns");
    write_integer(out, c->t_ns);
    write_name(out, "outputs");
    write_raw(out, "[");
    write_bytes(out, c->inside->said.text, c->inside->said.length);
    write_raw(out, "]");
    c->inside->said.length = 0;
    if (send_request(c) < 0)
        return -1;
    set_open(c->inside, 0);
    return 1;
}

int zsim_leave(zsim_client *c)
{
    if (!is_seated(c))
        return -1;
    c->inside->sits = 0;
    set_open(c->inside, 0);
    begin(c, "leave");
    return request(c, c->inside->timeout_s);
}
