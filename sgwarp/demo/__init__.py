"""A furnished room that ships with the package, and the whole path on it: lift, query, segment, measure."""
