"""Parts of scripts/loadtest: traces of users, their processes, the figures and the page."""
