"""Parts of scripts/loadtest: traces of users in a generated town, the processes, the figures and the page."""
