/*
 * The program: setup once, then one pass of the loop after the other.
 */
#ifndef AMB_DAQ_APP_H
#define AMB_DAQ_APP_H

void amb_setup(void);
void amb_loop(void);

#endif
