"""What each method can take: a table method × stressor, judged by truths that do not come from the library."""
