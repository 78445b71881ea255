"""The studio: robots, tasks, paths, recordings and rigs in three dimensions, in a browser.

What is shown is a model that knows no browser: `design` (a robot and a task, and how they are
changed), `workbench` (their answers), `texts` (what the panel says, and what is copied), `timeline`
(pressures over time) and `rig_watch` (a daemon). The views draw a model with viser, from the extra
``studio``: `task_view` with `task_inputs`, `answer_view`, `compare_view`, `map_view` and
`scene_view`; `timeline_view`, `rig_view`. `page` is their server, which answers only who shows the
key that the command prints. `opening` decides what a file is.
"""
