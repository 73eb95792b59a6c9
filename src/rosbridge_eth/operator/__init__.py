"""The operator's side: home and registry, enrolment of robots and readers, and how everything stands."""
