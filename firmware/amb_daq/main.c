/*
 * The program without the Arduino core, which brings its own main().
 */
#ifndef ARDUINO
#include "app.h"

int main(void)
{
    amb_setup();
    for (;;)
        amb_loop();
}
#else
typedef int main_is_in_the_core; /* a C file must not be empty */
#endif
