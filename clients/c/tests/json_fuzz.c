/* Feeds malformed lines to the JSON reader, each in a memory block of exactly its size, so that a sanitizer detects
   reads beyond its end. Usage: json_fuzz SEED ROUNDS < A_LINE */
#include "../zsim.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static uint64_t state;

/* xorshift64*, Vigna (2016) */
static uint64_t draw(void)
{
    state ^= state >> 12;
    state ^= state << 25;
    state ^= state >> 27;
    return state * 2685821657736338717u;
}

static size_t below(size_t limit)
{
    return (size_t)(draw() % limit);
}

/* Spoil a line: cut it, change bytes, repeat a part, or replace it by random bytes or random characters of JSON. */
static size_t spoil(char *line, size_t length, size_t size)
{
    static const char json[] = "{}[]\",:0123456789.eE+-\\utrfalsn ";
    size_t kind = below(6), count = 1 + below(8), from = below(length), part = 1 + below(length - from);
    if (kind == 0)
        return below(length + 1);
    if (kind == 1)
        for (; count > 0; count--)
            line[below(length)] = (char)draw();
    if (kind == 2)
        for (; count > 0; count--)
            line[below(length)] = json[below(sizeof json - 1)];
    if (kind == 3 && length + part <= size) {
        memmove(line + from + part, line + from, length - from);
        return length + part;
    }
    if (kind == 4)
        for (size_t i = 0; i < length; i++)
            line[i] = (char)draw();
    if (kind == 5)
        for (size_t i = 0; i < length; i++)
            line[i] = json[below(sizeof json - 1)];
    return length;
}

/* Call all readers; return how many values they found. */
static size_t read_all(zsim_json json, int depth)
{
    static const char *const paths[] = {"", "op", "value.position_m", "inputs.0.value.covariance", "0", "..", "id"};
    zsim_json name, entry;
    double numbers[36];
    int64_t number;
    char text[16];
    size_t at = 0, found = 0;
    for (size_t i = 0; i < sizeof paths / sizeof paths[0]; i++) {
        found += (size_t)zsim_number(json, paths[i], numbers);
        found += (size_t)zsim_numbers(json, paths[i], numbers, 3) + (size_t)zsim_numbers(json, paths[i], numbers, 36);
        found += (size_t)zsim_integer(json, paths[i], &number) + (size_t)zsim_text(json, paths[i], text, sizeof text);
        found += (size_t)zsim_is(json, paths[i], "gate") + (size_t)zsim_is_true(json, paths[i]);
    }
    while (depth < 3 && zsim_each(json, &at, &name, &entry))
        found += read_all(entry, depth + 1) + (size_t)zsim_text(name, "", text, sizeof text);
    return found;
}

int main(int count, char **arguments)
{
    static char given[65536], line[2 * sizeof given];
    size_t length = fread(given, 1, sizeof given, stdin), valid = 0, found = 0;
    long rounds = count > 2 ? atol(arguments[2]) : 1000;
    state = count > 1 ? strtoull(arguments[1], NULL, 10) : 1;
    if (length == 0 || state == 0)
        return printf("usage: json_fuzz SEED ROUNDS < A_LINE; SEED is not 0\n"), 2;
    for (long i = 0; i < rounds; i++) {
        size_t spoilt;
        char *exact;
        memcpy(line, given, length);
        spoilt = spoil(line, length, sizeof line);
        exact = malloc(spoilt > 0 ? spoilt : 1);
        if (exact == NULL)
            return 2;
        memcpy(exact, line, spoilt);
        zsim_json raw = {exact, spoilt};
        valid += zsim_parse(exact, spoilt).length > 0;
        found += read_all(raw, 0); /* even from invalid JSON: the readers must accept any bytes */
        free(exact);
    }
    printf("%ld lines, %lu of them JSON, %lu values\n", rounds, (unsigned long)valid, (unsigned long)found);
    return 0;
}
