/* Stations along an arm under gravity or loads. */
#define STIFFOPT_LOADED
#include "body.c"
