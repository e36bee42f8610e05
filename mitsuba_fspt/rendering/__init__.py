"""From a scene file to an image: the XML and its rules, loading, `render` and Mitsuba's Monte Carlo."""
