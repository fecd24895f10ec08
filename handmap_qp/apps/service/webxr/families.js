// The robots in a list to choose from, by family.

/** Robots by family (`allegro` of `allegro_left`): first the families of which one is installed. */
export function familyGroups(robots, missing) {
  const families = new Map();
  // Installed ones come first, so that the order of families is as wanted, and that within each.
  for (const name of [...robots, ...Object.keys(missing)]) {
    const family = name.replace(/_(left|right)$/, "");
    const option = new Option(name in missing ? `${name} (${missing[name]})` : name, name);
    option.disabled = name in missing;
    families.set(family, [...families.get(family) ?? [], option]);
  }
  return Array.from(families, ([family, options]) => {
    const group = document.createElement("optgroup");
    group.label = options.every(({ disabled }) => disabled) ? `${family}: not installed` : family;
    group.append(...options);
    return group;
  });
}
