/* The plant file: lines `key value`, `#` begins a comment. Unknown, doubled and missing keys are refused. */
#include "plant.h"

#include <errno.h>
#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#define AT(member) offsetof(struct plant_config, member)

/* Which kinds must have a key: bit by kind. */
enum { MUST_LINEAR = 1 << PLANT_LINEAR, MUST_PAIR = 1 << PLANT_DIFFERENTIAL, MUST_SINGLE = 1 << PLANT_SINGLE };
enum { MUST_MAGNET = MUST_PAIR | MUST_SINGLE, MUST_ALL = MUST_LINEAR | MUST_MAGNET };

static const struct number {
    const char *key;
    size_t at;
    double otherwise;
    int must, may, positive;
} numbers[] = {
    {"m", AT(m), 0, MUST_ALL, MUST_ALL, 1},
    {"R", AT(R), 0, MUST_ALL, MUST_ALL, 0},
    {"c", AT(c), 0, 0, MUST_ALL, 0},
    {"k_x", AT(k_x), 0, MUST_LINEAR, MUST_LINEAR, 0},
    {"k_i", AT(k_i), 0, MUST_LINEAR, MUST_LINEAR, 0},
    {"L", AT(L), 0, MUST_LINEAR, MUST_LINEAR, 1},
    {"rest_position", AT(rest[0]), 0, 0, MUST_LINEAR, 0},
    {"rest_current", AT(rest[1]), 0, 0, MUST_LINEAR, 0},
    {"rest_voltage", AT(rest[2]), 0, 0, MUST_LINEAR, 0},
    {"k", AT(k), 0, MUST_MAGNET, MUST_MAGNET, 1},
    {"gap", AT(gap), 0, MUST_PAIR, MUST_PAIR, 1},
    {"bias", AT(bias), 0, MUST_PAIR, MUST_PAIR, 1},
    {"leakage", AT(leakage), 0, 0, MUST_MAGNET, 0},
    {"gravity", AT(gravity), 0, 0, MUST_MAGNET, 0},
    {"stop_low", AT(stop[0]), -INFINITY, 0, MUST_ALL, 0},
    {"stop_high", AT(stop[1]), INFINITY, 0, MUST_ALL, 0},
    {"start_position", AT(start[0]), 0, MUST_SINGLE, MUST_ALL, 0},
    {"start_velocity", AT(start[1]), 0, 0, MUST_ALL, 0},
    {"start_current", AT(start[2]), 0, 0, MUST_ALL, 0},
    {"high_voltage", AT(high), 0, MUST_ALL, MUST_ALL, 0},
    {"low_voltage", AT(low), 0, MUST_ALL, MUST_ALL, 0},
    {"supply", AT(supply), NAN, 0, MUST_ALL, 1},
    {"force_noise", AT(force_noise), 0, 0, MUST_ALL, 0},
    {"voltage_noise", AT(voltage_noise), 0, 0, MUST_ALL, 0},
    {"position_noise", AT(position_noise), 0, 0, MUST_ALL, 0},
    {"current_noise", AT(current_noise), 0, 0, MUST_ALL, 0},
    {"position_gain", AT(sensor[PLANT_POSITION].position_gain), 0, 0, MUST_ALL, 0},
    {"position_offset", AT(sensor[PLANT_POSITION].offset), 0, 0, MUST_ALL, 0},
    {"current_gain", AT(sensor[PLANT_CURRENT].current_gain), 0, 0, MUST_ALL, 0},
    {"current_offset", AT(sensor[PLANT_CURRENT].offset), 0, 0, MUST_ALL, 0},
    {"third_position_gain", AT(sensor[PLANT_THIRD].position_gain), 0, 0, MUST_ALL, 0},
    {"third_current_gain", AT(sensor[PLANT_THIRD].current_gain), 0, 0, MUST_ALL, 0},
    {"third_offset", AT(sensor[PLANT_THIRD].offset), 0, 0, MUST_ALL, 0},
    {"pin_noise", AT(sensor[PLANT_POSITION].noise), 0, 0, MUST_ALL, 0},
};
enum { NUMBERS = sizeof numbers / sizeof numbers[0] };

static const struct word {
    const char *key, *word;
    size_t at;
    int value;
} words[] = {
    {"kind", "linear", AT(kind), PLANT_LINEAR},
    {"kind", "differential", AT(kind), PLANT_DIFFERENTIAL},
    {"kind", "single", AT(kind), PLANT_SINGLE},
    {"off", "diodes", AT(diodes), 1},
    {"off", "short", AT(diodes), 0},
    {"pwm", "switched", AT(averaged), 0},
    {"pwm", "averaged", AT(averaged), 1},
    {"current", "both-ways", AT(one_way), 0},
    {"current", "one-way", AT(one_way), 1},
};
enum { WORDS = sizeof words / sizeof words[0] };

static double *place_of(struct plant_config *config, size_t at) { return (double *)(void *)((char *)config + at); }

static int as_number(const char *text, double *value)
{
    char *end;
    errno = 0;
    *value = strtod(text, &end);
    return end != text && *end == '\0' && errno == 0 && !isnan(*value);
}

/* `position_point VOLTS METRES` or `current_point VOLTS AMPERES`. */
static const char *take_point(struct plant_config *config, const char *key, const char *first, const char *second)
{
    struct sensor *s = &config->sensor[key[0] == 'p' ? PLANT_POSITION : PLANT_CURRENT];
    double volts, quantity;
    if (second == NULL || !as_number(first, &volts) || !as_number(second, &quantity))
        return "wants two numbers: volts at the pin, and the quantity";
    if (s->points == PLANT_POINTS)
        return "has more points than 256";
    const int n = s->points;
    if (n > 0 && quantity == s->quantity[n - 1])
        return "repeats a quantity; a table must rise or fall";
    if (n > 1 && (quantity > s->quantity[n - 1]) != (s->quantity[n - 1] > s->quantity[n - 2]))
        return "turns round; a table must rise or fall";
    s->volts[n] = volts;
    s->quantity[n] = quantity;
    s->points = n + 1;
    return NULL;
}

/* Returns NULL, or what is wrong with the line. */
static const char *take(struct plant_config *config, char seen[NUMBERS], const char *key, const char *value)
{
    int known = 0;
    for (int k = 0; k < WORDS; k++) {
        if (strcmp(words[k].key, key) != 0)
            continue;
        known = 1;
        if (strcmp(words[k].word, value) == 0) {
            memcpy((char *)config + words[k].at, &words[k].value, sizeof words[k].value);
            return NULL;
        }
    }
    if (known)
        return "is not a word that this key takes; see firmware/bench/README.md";
    for (int k = 0; k < NUMBERS; k++) {
        if (strcmp(numbers[k].key, key) != 0)
            continue;
        double *place = place_of(config, numbers[k].at);
        if (seen[k]++)
            return "is given twice";
        if (!as_number(value, place))
            return "is not a number";
        if (numbers[k].positive && !(*place > 0.0))
            return "must be positive";
        return NULL;
    }
    return "is not a known key; see firmware/bench/README.md";
}

static int lacks(const struct plant_config *config, const char seen[NUMBERS], const char *path, FILE *complaints)
{
    if (config->kind == PLANT_NO_KIND) {
        fprintf(complaints, "%s: no kind; give: kind linear, differential or single\n", path);
        return 1;
    }
    for (int k = 0; k < NUMBERS; k++) {
        const int kind = 1 << config->kind;
        if (!seen[k] && (numbers[k].must & kind)) {
            fprintf(complaints, "%s: %s is missing; this kind of plant needs it\n", path, numbers[k].key);
            return 1;
        }
        if (seen[k] && !(numbers[k].may & kind)) {
            fprintf(complaints, "%s: %s does not belong to this kind of plant; remove it\n", path, numbers[k].key);
            return 1;
        }
    }
    const int linear = config->kind == PLANT_LINEAR, pair = config->kind == PLANT_DIFFERENTIAL;
    const double closed_low = pair ? -config->gap : 0.0, closed_high = config->gap;
    const int inside = linear || (config->stop[0] > closed_low && (!pair || config->stop[1] < closed_high));
    if (!inside || !(config->stop[0] < config->stop[1])) {
        fprintf(complaints, "%s: stop_low must be below stop_high, and both inside the air gap\n", path);
        return 1;
    }
    if (!(config->start[0] >= config->stop[0] && config->start[0] <= config->stop[1])) {
        fprintf(complaints, "%s: start_position is outside the stops\n", path);
        return 1;
    }
    for (int k = 0; k < PLANT_SENSORS; k++)
        if (config->sensor[k].points == 1) {
            fprintf(complaints, "%s: a table of one point; give two or more\n", path);
            return 1;
        }
    return 0;
}

int plant_read(const char *path, struct plant_config *config, FILE *complaints)
{
    char seen[NUMBERS] = {0}, line[512];
    memset(config, 0, sizeof *config);
    config->kind = PLANT_NO_KIND;
    config->diodes = 1;
    for (int k = 0; k < NUMBERS; k++)
        *place_of(config, numbers[k].at) = numbers[k].otherwise;
    FILE *file = fopen(path, "r");
    if (file == NULL) {
        fprintf(complaints, "%s: %s\n", path, strerror(errno));
        return -1;
    }
    int bad = 0;
    for (int number = 1; !bad && fgets(line, sizeof line, file) != NULL; number++) {
        line[strcspn(line, "#\r\n")] = '\0';
        const char *key = strtok(line, " \t"), *value = strtok(NULL, " \t"), *second = strtok(NULL, " \t");
        if (key == NULL)
            continue;
        const int point = strcmp(key, "position_point") == 0 || strcmp(key, "current_point") == 0;
        const char *wrong = value == NULL                     ? "has no value"
                            : point                           ? take_point(config, key, value, second)
                            : second != NULL                  ? "has more than one value"
                                                              : take(config, seen, key, value);
        if (wrong != NULL) {
            fprintf(complaints, "%s:%d: %s %s: %s\n", path, number, key, value ? value : "", wrong);
            bad = 1;
        }
    }
    fclose(file);
    if (bad || lacks(config, seen, path, complaints))
        return -1;
    if (isnan(config->supply))
        config->supply = fmax(fabs(config->high), fabs(config->low));
    for (int k = 1; k < PLANT_SENSORS; k++)
        config->sensor[k].noise = config->sensor[PLANT_POSITION].noise;
    return 0;
}
