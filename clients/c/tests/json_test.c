/* Tests the JSON reader and writer of zsim.c. Prints a line for each failed expectation, and then exits with 1. */
#include "../zsim.h"

#include <float.h>
#include <locale.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int failures;

#define EXPECT(condition)                                                                                            \
    do {                                                                                                             \
        if (!(condition)) {                                                                                          \
            failures++;                                                                                              \
            printf("json_test.c:%d: %s\n", __LINE__, #condition);                                                    \
        }                                                                                                            \
    } while (0)

static zsim_json parse(const char *text)
{
    return zsim_parse(text, strlen(text));
}

static int is_json(const char *text)
{
    return parse(text).length > 0;
}

static void it_takes_json_and_nothing_else(void)
{
    static const char *const good[] = {
        "{}", "[]", "0", "-0", "1.5e-7", "\"\"", "true", "false", "null", " [ 1 , { \"a\" : [ ] } ] ",
        "{\"a\":1,\"b\":[true,null]}", "\"\\u00e9\\n\\\"\"", "[[[[]]],{}]", "1E+2", "\"\xc3\xa9\"",
    };
    static const char *const bad[] = {
        "", " ", "{", "[", "]", "[1,]", "[1 2]", "{\"a\"}", "{\"a\":}", "{\"a\":1,}", "{a:1}", "{1:1}", "[1}", "{\"a\":1]",
        "01", "1.", ".5", "+1", "-", "1e", "1e+", "0x10", "NaN", "Infinity", "nul", "tru", "truee", "\"", "\"\\\"",
        "\"\\x\"", "\"\\u12\"", "\"\\u12g4\"", "\"\n\"", "[1]]", "{}{}", "1 2", "\"a\" \"b\"", "[,1]", "{,}",
    };
    for (size_t i = 0; i < sizeof good / sizeof good[0]; i++)
        EXPECT(is_json(good[i]) || (printf("  refused: %s\n", good[i]), 0));
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++)
        EXPECT(!is_json(bad[i]) || (printf("  taken: %s\n", bad[i]), 0));
}

static void nesting_is_limited(void)
{
    char text[2000];
    memset(text, '[', 64);
    memset(text + 64, ']', 64);
    EXPECT(zsim_parse(text, 128).length == 128);
    memset(text, '[', 65);
    memset(text + 65, ']', 65);
    EXPECT(zsim_parse(text, 130).length == 0);
    memset(text, '[', sizeof text);
    EXPECT(zsim_parse(text, sizeof text).length == 0);
}

static void paths_lead_to_values(void)
{
    zsim_json json = parse("{\"value\": {\"position_m\": [1, -2.5, 3e2], \"t_ns\": 20000000, \"state\": \"flying\", "
                           "\"valid\": true, \"none\": null, \"list\": [{\"x\": 7}, {\"x\": 8}], \"a\\u0062\": 9}}");
    double p[3] = {0, 0, 0}, x = 5;
    int64_t t_ns = -1;
    EXPECT(zsim_numbers(json, "value.position_m", p, 3) && p[0] == 1.0 && p[1] == -2.5 && p[2] == 300.0);
    EXPECT(zsim_number(json, "value.position_m.1", &x) && x == -2.5);
    EXPECT(zsim_integer(json, "value.t_ns", &t_ns) && t_ns == 20000000);
    EXPECT(zsim_is(json, "value.state", "flying") && !zsim_is(json, "value.state", "fly"));
    EXPECT(!zsim_is(json, "value.state", "flying!") && !zsim_is(json, "value.t_ns", "20000000"));
    EXPECT(zsim_is_true(json, "value.valid") && !zsim_is_true(json, "value.none"));
    EXPECT(zsim_number(json, "value.list.1.x", &x) && x == 8.0);
    EXPECT(zsim_number(json, "value.ab", &x) && x == 9.0);
    EXPECT(zsim_get(json, "value.none").length == 4 && zsim_get(json, "").length == json.length);
}

static void what_is_not_there_leaves_things_alone(void)
{
    zsim_json json = parse("{\"p\": [1, 2, 3], \"q\": [1, null, 3], \"s\": \"seven\", \"n\": 1.5, \"e\": []}");
    double p[3] = {7, 7, 7}, x = 7;
    int64_t n = 7;
    char text[5] = "old";
    EXPECT(!zsim_numbers(json, "p", p, 2) && !zsim_numbers(json, "q", p, 3) && !zsim_numbers(json, "s", p, 3));
    EXPECT(!zsim_numbers(json, "r", p, 3) && !zsim_numbers(json, "p.0", p, 1) && !zsim_numbers(json, "e", p, 1));
    EXPECT(p[0] == 7.0 && p[1] == 7.0 && p[2] == 7.0);
    EXPECT(zsim_numbers(json, "e", p, 0));
    EXPECT(!zsim_number(json, "s", &x) && !zsim_number(json, "p", &x) && !zsim_number(json, "p.3", &x) && x == 7.0);
    EXPECT(!zsim_number(json, "p.-1", &x) && !zsim_number(json, "p.01x", &x) && !zsim_number(json, "n.0", &x));
    EXPECT(!zsim_number(json, ".", &x) && !zsim_number(json, "p.", &x) && !zsim_number(json, "p..0", &x) && x == 7.0);
    EXPECT(!zsim_integer(json, "n", &n) && !zsim_integer(json, "s", &n) && n == 7);
    EXPECT(!zsim_text(json, "s", text, sizeof text) && strcmp(text, "old") == 0); /* needs six bytes */
    EXPECT(!zsim_text(json, "n", text, sizeof text));
}

static void integers_are_exact_and_do_not_wrap(void)
{
    int64_t n = 0;
    EXPECT(zsim_integer(parse("9223372036854775807"), "", &n) && n == INT64_MAX);
    EXPECT(zsim_integer(parse("-9223372036854775808"), "", &n) && n == INT64_MIN);
    n = 7;
    EXPECT(!zsim_integer(parse("9223372036854775808"), "", &n) && !zsim_integer(parse("-9223372036854775809"), "", &n));
    EXPECT(!zsim_integer(parse("99999999999999999999999999"), "", &n) && !zsim_integer(parse("1e3"), "", &n) && n == 7);
}

static void huge_numbers_are_refused(void)
{
    char digits[1000];
    double x = 7;
    EXPECT(!zsim_number(parse("1e400"), "", &x) && !zsim_number(parse("-1e99999999999"), "", &x) && x == 7.0);
    EXPECT(zsim_number(parse("1e-400"), "", &x) && x == 0.0);
    memset(digits, '9', sizeof digits);
    x = 7;
    EXPECT(!zsim_number(zsim_parse(digits, sizeof digits), "", &x) && x == 7.0);
    EXPECT(zsim_number(zsim_parse(digits, 300), "", &x) && x == 1e300);
}

static void texts_are_unescaped(void)
{
    char text[64];
    EXPECT(zsim_text(parse("\"a\\\"\\\\\\/\\b\\f\\n\\r\\t\""), "", text, sizeof text) &&
           strcmp(text, "a\"\\/\b\f\n\r\t") == 0);
    EXPECT(zsim_text(parse("\"\\u00e9\\u20ac\\ud83d\\ude81\""), "", text, sizeof text) &&
           strcmp(text, "\xc3\xa9\xe2\x82\xac\xf0\x9f\x9a\x81") == 0);
    EXPECT(zsim_text(parse("\"\\u0000|\\ud83d|\\ude81|\\ud83d\\u0041\""), "", text, sizeof text) &&
           strcmp(text, "\xef\xbf\xbd|\xef\xbf\xbd|\xef\xbf\xbd|\xef\xbf\xbd" "A") == 0);
    EXPECT(zsim_text(parse("\"1234\""), "", text, 5) && strcmp(text, "1234") == 0);
}

static void lists_and_maps_are_gone_through(void)
{
    zsim_json name, entry;
    size_t at = 0;
    double sum = 0, x = 0;
    zsim_json list = parse("[1, 2, 3]"), map = parse("{\"a\": 10, \"b\": 20}");
    while (zsim_each(list, &at, &name, &entry))
        sum += zsim_number(entry, "", &x) && name.length == 0 ? x : 100;
    EXPECT(sum == 6.0);
    at = 0;
    EXPECT(zsim_each(map, &at, &name, &entry) && zsim_is(name, "", "a") && zsim_number(entry, "", &x) && x == 10.0);
    EXPECT(zsim_each(map, &at, &name, &entry) && zsim_is(name, "", "b") && zsim_number(entry, "", &x) && x == 20.0);
    EXPECT(!zsim_each(map, &at, &name, &entry) && !zsim_each(map, &at, &name, &entry));
    at = 0;
    EXPECT(!zsim_each(parse("[]"), &at, &name, &entry) && !zsim_each(parse("7"), &at, &name, &entry));
}

static double from_bits(uint64_t bits)
{
    double number;
    memcpy(&number, &bits, sizeof number);
    return number;
}

static int comes_back(double number)
{
    char text[32];
    double read = 0;
    if (!zsim_format(number, text) || strpbrk(text, ", ") != NULL)
        return 0;
    return zsim_number(parse(text), "", &read) && memcmp(&read, &number, sizeof read) == 0;
}

static void numbers_come_back_as_the_same_bits(void)
{
    uint64_t bits = 88172645463325252u; /* xorshift64 of Marsaglia (2003) */
    char text[32];
    EXPECT(comes_back(0.0) && comes_back(-0.0) && comes_back(0.1) && comes_back(1.0 / 3.0) && comes_back(-1e22));
    EXPECT(comes_back(DBL_MAX) && comes_back(-DBL_MAX) && comes_back(DBL_MIN) && comes_back(from_bits(1)));
    for (int i = 0; i < 20000; i++) {
        bits ^= bits << 13;
        bits ^= bits >> 7;
        bits ^= bits << 17;
        if (isfinite(from_bits(bits)))
            EXPECT(comes_back(from_bits(bits)));
    }
    EXPECT(!zsim_format(NAN, text) && !zsim_format(INFINITY, text));
}

int main(int count, char **arguments)
{
    if (count > 1 && setlocale(LC_ALL, arguments[1]) == NULL)
        return printf("there is no locale %s\n", arguments[1]), 2;
    it_takes_json_and_nothing_else();
    nesting_is_limited();
    paths_lead_to_values();
    what_is_not_there_leaves_things_alone();
    integers_are_exact_and_do_not_wrap();
    huge_numbers_are_refused();
    texts_are_unescaped();
    lists_and_maps_are_gone_through();
    numbers_come_back_as_the_same_bits();
    printf("decimal point %s, %d failures\n", localeconv()->decimal_point, failures);
    return failures > 0;
}
