/* Each line is written at once, so that a test may read the file while the bench runs. */
#include "journal.h"

#include <errno.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>

static FILE *file;

int journal_open(const char *path)
{
    struct stat what;
    if (path == NULL)
        return 0;
    if (stat(path, &what) == 0 && !S_ISREG(what.st_mode)) {
        fprintf(stderr, "amb_bench: --log %s is no regular file; an unread pipe would stop the bench\n", path);
        return -1;
    }
    file = fopen(path, "w");
    if (file == NULL) {
        fprintf(stderr, "amb_bench: --log %s: %s\n", path, strerror(errno));
        return -1;
    }
    return 0;
}

void journal_write(double time_s, const char *event, const char *more, ...)
{
    if (file == NULL)
        return;
    fprintf(file, "{\"t\": %.8f, \"event\": \"%s\"", time_s, event);
    if (more != NULL) {
        va_list values;
        va_start(values, more);
        fputs(", ", file);
        vfprintf(file, more, values);
        va_end(values);
    }
    fputs("}\n", file);
    fflush(file);
}

void journal_close(void)
{
    if (file != NULL)
        fclose(file);
    file = NULL;
}

const char *journal_quoted(const char *text)
{
    static char out[1024];
    size_t n = 0;
    for (; *text != '\0' && n + 7 < sizeof out; text++) {
        const unsigned char c = (unsigned char)*text;
        if (c == '"' || c == '\\') {
            out[n++] = '\\';
            out[n++] = *text;
        } else if (c < 0x20) {
            n += (size_t)snprintf(out + n, 7, "\\u%04x", c);
        } else {
            out[n++] = *text;
        }
    }
    out[n] = '\0';
    return out;
}
