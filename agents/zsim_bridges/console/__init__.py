"""The operator's console: a page in the browser that shows a run and steers it. Imports viser and aiohttp."""
