/* The clearance of an arm under gravity or loads. */
#define STIFFOPT_LOADED
#include "clearance.c"
