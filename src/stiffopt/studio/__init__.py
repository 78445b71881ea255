"""The studio: show robots, tasks, paths, recordings and rigs in 3-D in a browser.

The models are independent of the browser: `design` (a robot and a task, with their changes),
`workbench` (solutions of a design), `texts` (contents of the panel and of copies), `timeline`
(pressures over time) and `rig_watch` (a daemon). The views draw the models with viser, from the
extra ``studio``: `task_view` with `task_inputs`, `answer_view`, `compare_view`, `map_view` and
`scene_view`; `timeline_view`; `rig_view`. `page` is the server, which answers only requests with
the key that the command prints. `opening` opens the view for a kind of file.
"""
