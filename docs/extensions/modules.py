"""What Griffe cannot know of Equinox: the arguments of a module, and which methods are properties."""

import griffe


class EquinoxModules(griffe.Extension):
    """Gives modules without an `__init__` the one that their fields make, and marks our properties."""

    def on_class(self, *, cls: griffe.Class, **kwargs) -> None:
        """Called when a class and its members have been read."""
        for member in [*cls.members.values()]:
            if member.is_function and any(
                "compiled_property" in str(d.value) for d in member.decorators
            ):
                cls.set_member(member.name, _as_property(member))
        if "__init__" not in cls.members:
            parameters = [*filter(None, map(_parameter, cls.members.values()))]
            if parameters:
                parameters.sort(key=lambda p: p.kind is griffe.ParameterKind.keyword_only)
                this = griffe.Parameter("self", kind=griffe.ParameterKind.positional_or_keyword)
                init = griffe.Function("__init__", parameters=griffe.Parameters(this, *parameters))
                cls.set_member("__init__", init)

    def on_package(self, *, pkg: griffe.Module, **kwargs) -> None:
        """Called when all is read: what is exported twice is to be found under both names."""
        for member in pkg.members.values():
            if member.is_alias and member.target_path.startswith(f"{pkg.path}."):
                member.final_target.aliases[member.path] = member


def _as_property(function: griffe.Function) -> griffe.Attribute:
    attribute = griffe.Attribute(
        function.name,
        annotation=function.returns,
        docstring=function.docstring,
        lineno=function.lineno,
        endlineno=function.endlineno,
    )
    attribute.labels |= {"property"}
    return attribute


def _parameter(field: griffe.Object) -> griffe.Parameter | None:
    if not field.is_attribute or field.annotation is None or "property" in field.labels:
        return None
    if any(word in str(field.annotation) for word in ("ClassVar", "AbstractVar")):
        return None
    default, kind = field.value, griffe.ParameterKind.positional_or_keyword
    if isinstance(default, griffe.ExprCall) and str(default.function) == "eqx.field":
        options = {a.name: a.value for a in default.arguments if isinstance(a, griffe.ExprKeyword)}
        if str(options.get("init")) == "False":
            return None
        if str(options.get("kw_only")) == "True":
            kind = griffe.ParameterKind.keyword_only
        default = options.get("default")
        if "default_factory" in options:
            default = f"{options['default_factory']}()"
    return griffe.Parameter(field.name, annotation=field.annotation, default=default, kind=kind)
