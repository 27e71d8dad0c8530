/* Calls a function of zsim.h for each line of standard input, and prints what it returned and set. For the tests.

       connect PORT TIMEOUT_S NAME [TOKEN]      subscribe KEY      next TIMEOUT_S         latest KEY PATH
       begin KEY                                add NAME TEXT      end
       velocity DRONE X Y Z YAW_RATE [FRAME]    mode DRONE MODE    put KEY JSON           fields KEY NUMBER TEXT
       join NAME PERIOD_S READS,..              gate TIMEOUT_S     input KEY PATH         done
       ask KEY REQUEST [ARGS]                   hello              unsubscribe KEY        leave     close */
#include "../zsim.h"

#include <locale.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { WORDS = 8 };

static zsim_client c;

static void told(int result)
{
    if (result < 0)
        printf("-1 %s\n", c.error);
    else
        printf("%d\n", result);
}

/* Print the value at a path, or the failure. */
static void found(int result, zsim_json json, const char *path)
{
    zsim_json value;
    if (result <= 0) {
        told(result);
        return;
    }
    value = zsim_get(json, path);
    printf("1 %.*s\n", (int)value.length, value.length > 0 ? value.text : "");
}

static void talk_of_values(char *word[WORDS])
{
    zsim_value value;
    zsim_json json;
    int result;
    if (strcmp(word[0], "subscribe") == 0) {
        told(zsim_subscribe(&c, word[1]));
    } else if (strcmp(word[0], "unsubscribe") == 0) {
        told(zsim_unsubscribe(&c, word[1]));
    } else if (strcmp(word[0], "latest") == 0) {
        result = zsim_latest(&c, word[1], &json);
        found(result, json, word[2]);
    } else if (strcmp(word[0], "next") == 0) {
        result = zsim_next(&c, &value, strtod(word[1], NULL));
        if (result > 0)
            printf("1 %s %.*s lost %lu\n", value.key, (int)value.value.length, value.value.text, (unsigned long)c.lost);
        else
            told(result);
    }
}

static void talk_of_commands(char *word[WORDS])
{
    double v[3];
    if (strcmp(word[0], "velocity") == 0) {
        for (int i = 0; i < 3; i++)
            v[i] = strtod(word[2 + i], NULL);
        told(zsim_velocity(&c, word[1], v, strtod(word[5], NULL), *word[6] ? word[6] : NULL));
    } else if (strcmp(word[0], "mode") == 0) {
        told(zsim_mode(&c, word[1], word[2]));
    } else if (strcmp(word[0], "put") == 0) {
        told(zsim_put(&c, word[1], word[2]));
    } else if (strcmp(word[0], "fields") == 0) {
        zsim_put_begin(&c, word[1]);
        zsim_add_number(&c, "number", strtod(word[2], NULL));
        zsim_add_text(&c, "text", word[3]);
        zsim_add_integer(&c, "integer", INT64_MIN);
        zsim_add_json(&c, "json", "{\"a\":\n[1, 2]}");
        told(zsim_put_end(&c));
    } else if (strcmp(word[0], "begin") == 0) {
        zsim_put_begin(&c, word[1]);
        told(1);
    } else if (strcmp(word[0], "add") == 0) {
        zsim_add_text(&c, word[1], word[2]);
        told(1);
    } else if (strcmp(word[0], "end") == 0) {
        told(zsim_put_end(&c));
    } else if (strcmp(word[0], "ask") == 0) {
        found(zsim_ask(&c, word[1], word[2], *word[3] ? word[3] : NULL), c.answer, "result");
    }
}

static void talk_of_time(char *word[WORDS])
{
    if (strcmp(word[0], "join") == 0) {
        for (char *comma = word[3]; (comma = strchr(comma, ',')) != NULL;)
            *comma = ' ';
        told(zsim_join(&c, word[1], strtod(word[2], NULL), word[3], NULL));
    } else if (strcmp(word[0], "gate") == 0) {
        told(zsim_gate(&c, strtod(word[1], NULL)));
    } else if (strcmp(word[0], "input") == 0) {
        found(1, zsim_input(&c, word[1]), word[2]);
    } else if (strcmp(word[0], "done") == 0) {
        told(zsim_done(&c));
    } else if (strcmp(word[0], "leave") == 0) {
        told(zsim_leave(&c));
    }
}

static void talk(char *word[WORDS])
{
    if (strcmp(word[0], "connect") == 0) {
        int result = zsim_connect(&c, "127.0.0.1", atoi(word[1]), word[3], *word[4] ? word[4] : NULL, strtod(word[2], NULL));
        if (result > 0)
            printf("1 %s %s %s %g %lld\n", c.name, c.run_id, c.mode, c.gate_s, (long long)c.t_ns);
        else
            told(result);
    } else if (strcmp(word[0], "hello") == 0) {
        told(zsim_hello(&c));
    } else if (strcmp(word[0], "close") == 0) {
        zsim_close(&c);
        told(1);
    } else {
        talk_of_values(word);
        talk_of_commands(word);
        talk_of_time(word);
    }
    fflush(stdout);
}

int main(int count, char **arguments)
{
    static char line[65536];
    if (count > 1 && setlocale(LC_ALL, arguments[1]) == NULL)
        return printf("there is no locale %s\n", arguments[1]), 2;
    while (fgets(line, sizeof line, stdin) != NULL) {
        char nothing[] = "", *word[WORDS], *at = strtok(line, " \n");
        for (int i = 0; i < WORDS; i++) {
            word[i] = at != NULL ? at : nothing;
            at = at != NULL ? strtok(NULL, " \n") : NULL;
        }
        if (*word[0])
            talk(word);
    }
    zsim_close(&c);
    return 0;
}
