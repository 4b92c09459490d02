/*
 * Sketch for the Arduino IDE: all of the program is in the C files of this folder. See README.md.
 */
extern "C" {
#include "app.h"
}

void setup() { amb_setup(); }

void loop() { amb_loop(); }
