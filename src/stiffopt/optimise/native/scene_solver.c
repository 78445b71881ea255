/* The solver of solver.c for tasks with a scene. */
#define STIFFOPT_SCENE
#include "solver.c"
