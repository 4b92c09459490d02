/* The log: one JSON object per line, with emulated time. It is a regular file: an unread pipe would stop the bench. */
#ifndef AMB_BENCH_JOURNAL_H
#define AMB_BENCH_JOURNAL_H

/* Returns 0, or -1 after one line on standard error. NULL: no log. */
int journal_open(const char *path);
void journal_write(double time_s, const char *event, const char *more, ...) __attribute__((format(printf, 3, 4)));
void journal_close(void);

/* `text` as it stands inside a JSON string; the answer is overwritten by the next call. */
const char *journal_quoted(const char *text);

#endif
