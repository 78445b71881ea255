/* The solver of solver.c for an arm under gravity or loads, and tasks with a scene. */
#define STIFFOPT_SCENE
#include "loaded_solver.c"
