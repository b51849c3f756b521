"""A run, or several, as one HTML page that needs nothing else: `--html` of `aeroloop log review` and `compare`.

page.py puts it together. What can be read without a script is written here as HTML (verdict.py, happenings.py and
setup.py, by markup.py, with the figures of ../rows.py); what is drawn goes along as data (data.py), and the browser
draws it (*.js, in the colours of page.css). Nothing that comes from a log is ever markup, and the page's own policy
lets it run no script but its own and fetch nothing.
"""
