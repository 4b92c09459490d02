/* Reading and ordering of a script; nothing of it is carried out here. */
#include "script.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "plant.h"

enum { WORDS = 4 };

static int as_number(const char *text, double *value)
{
    char *end;
    if (text == NULL)
        return 0;
    *value = strtod(text, &end);
    return end != text && *end == '\0' && isfinite(*value);
}

static int one_of(const char *word, const char *const *known, int n)
{
    for (int k = 0; word != NULL && k < n; k++)
        if (strcmp(word, known[k]) == 0)
            return k;
    return -1;
}

/* Returns NULL, or what is wrong. `word[0]` is the deed. */
static const char *take(struct event *e, char *word[WORDS])
{
    static const char *const deeds[] = {"force", "pulse", "override", "interlock", "cable", "line", "lockstep", "end"};
    static const char *const pins[] = {"position", "current", "third"};
    static const char *const loops[] = {"closed", "open"};
    static const char *const cables[] = {"mend", "cut"};
    switch (one_of(word[0], deeds, 8)) {
    case 0:
        e->deed = DEED_FORCE;
        return as_number(word[1], &e->number) ? NULL : "force wants newtons";
    case 1:
        e->deed = DEED_PULSE;
        if (!as_number(word[1], &e->number) || !as_number(word[2], &e->second) || e->second <= 0.0)
            return "pulse wants newtons and seconds";
        return NULL;
    case 2:
        e->deed = DEED_OVERRIDE;
        e->which = one_of(word[1], pins, 3);
        if (e->which < 0)
            return "override wants position, current or third";
        e->number = NAN;
        if (word[2] != NULL && strcmp(word[2], "off") == 0)
            return NULL;
        return as_number(word[2], &e->number) ? NULL : "override wants volts at the pin, or off";
    case 3:
        e->deed = DEED_INTERLOCK;
        e->which = one_of(word[1], loops, 2);
        return e->which >= 0 ? NULL : "interlock wants open or closed";
    case 4:
        e->deed = DEED_CABLE;
        e->which = one_of(word[1], cables, 2);
        if (e->which < 0)
            return "cable wants cut, cut low or mend";
        if (word[2] != NULL && strcmp(word[2], "low") == 0 && e->which == 1)
            e->which = 2;
        else if (word[2] != NULL)
            return "cable wants cut, cut low or mend";
        return NULL;
    case 5:
        e->deed = DEED_LINE;
        if (word[1] == NULL || strcmp(word[1], "damage") != 0 || !as_number(word[2], &e->number))
            return "line wants: damage CHANCE";
        return e->number >= 0.0 && e->number <= 1.0 ? NULL : "the chance of damage is 0 to 1";
    case 6:
        e->deed = DEED_LOCKSTEP;
        return as_number(word[1], &e->number) && e->number >= 0.0 ? NULL : "lockstep wants ms";
    case 7:
        e->deed = DEED_END;
        return NULL;
    default:
        return "it knows force, pulse, override, interlock, cable, line damage, lockstep, end";
    }
}

static const char *take_line(struct script *script, char *line)
{
    char text[SCRIPT_TEXT], *word[WORDS + 1];
    line[strcspn(line, "#\r\n")] = '\0';
    snprintf(text, sizeof text, "%.*s", SCRIPT_TEXT - 1, line);
    char *when = strtok(line, " \t");
    if (when == NULL)
        return NULL;
    for (int k = 0; k <= WORDS; k++)
        word[k] = strtok(NULL, " \t");
    if (script->n == SCRIPT_EVENTS - 32)
        return "there are more lines than the bench has room for";
    struct event *e = &script->event[script->n];
    memset(e, 0, sizeof *e);
    memcpy(e->text, text, sizeof text);
    e->after_enable = when[0] == '+';
    double seconds;
    if (!as_number(when + e->after_enable, &seconds) || seconds < 0.0)
        return "a line begins with seconds, or +seconds from the first ENABLE on";
    e->tick = (uint64_t)llround(seconds * PLANT_TICK_HZ);
    const char *wrong = take(e, word);
    if (wrong == NULL && word[3] != NULL)
        wrong = "there is a word too many";
    script->n += wrong == NULL;
    return wrong;
}

int script_read(const char *path, struct script *script)
{
    char line[512];
    script->n = 0;
    if (path == NULL)
        return 0;
    FILE *file = fopen(path, "r");
    if (file == NULL) {
        fprintf(stderr, "amb_bench: --script %s: %s\n", path, strerror(errno));
        return -1;
    }
    const char *wrong = NULL;
    int number = 0;
    while (wrong == NULL && fgets(line, sizeof line, file) != NULL) {
        number++;
        wrong = take_line(script, line);
    }
    fclose(file);
    if (wrong != NULL) {
        fprintf(stderr, "amb_bench: %s:%d: %s\n", path, number, wrong);
        return -1;
    }
    return 0;
}

struct event *script_due(struct script *script, uint64_t now, uint64_t enabled)
{
    struct event *first = NULL;
    uint64_t earliest = 0;
    for (size_t k = 0; k < script->n; k++) {
        struct event *e = &script->event[k];
        if (e->done || (e->after_enable && enabled == UINT64_MAX))
            continue;
        const uint64_t at = e->tick + (e->after_enable ? enabled : 0);
        if (at <= now && (first == NULL || at < earliest)) {
            first = e;
            earliest = at;
        }
    }
    return first;
}

int script_add_end_of_pulse(struct script *script, uint64_t tick, double newton)
{
    size_t k = 0;
    while (k < script->n && !script->event[k].done)
        k++;
    if (k == SCRIPT_EVENTS)
        return -1;
    struct event *e = &script->event[k];
    memset(e, 0, sizeof *e);
    e->tick = tick;
    e->deed = DEED_PULSE_END;
    e->number = newton;
    snprintf(e->text, sizeof e->text, "end of pulse %g", newton);
    script->n += k == script->n;
    return 0;
}
