"""The console: one run on a web page that viser draws, for operators, who control it, and viewers, who only watch.

Its modules, by task:
- serving: `page_server` (HTTP, tokens, viser), `page_sockets` (actions, pictures);
- one run: `console_server` ties its parts together; `console_page`, `console_tables` and the forms are the panels;
  `scene`, `picture` and `page_cameras` draw the scene; `manual_flight` flies single drones;
- requests: `orders` sends and tracks them, `control_desk` decides which page may send them;
- state of the run: `view_buffer`, `run_monitor`, `run_condition`, `camera_feed`, `histories`.
The parts of the page that are not viser's are HTML files in `frame`. Imports viser and aiohttp.
"""
