// A roscpp node under a test's hand, with services of types that every ROS 1 has:
//
//   services serve                 /lamp/set (SetLoggerLevel; fails for the level `broken`) and /lamp/get (GetLoggers)
//   services call NODE NAME LEVEL  sets, asks twice over one persistent connection, and prints `NAME LEVEL` of each;
//                                  then makes the server fail, calls a service that is not there: `refused` twice
#include <iostream>
#include <map>
#include <string>

#include <ros/ros.h>
#include <roscpp/GetLoggers.h>
#include <roscpp/SetLoggerLevel.h>

static std::map<std::string, std::string> levels;

static bool set(roscpp::SetLoggerLevel::Request& request, roscpp::SetLoggerLevel::Response&) {
    if (request.level == "broken") return false;
    levels[request.logger] = request.level;
    return true;
}

static bool get(roscpp::GetLoggers::Request&, roscpp::GetLoggers::Response& response) {
    for (const auto& item : levels) {
        roscpp::Logger logger;
        logger.name = item.first;
        logger.level = item.second;
        response.loggers.push_back(logger);
    }
    return true;
}

static int call(const std::string& node, const std::string& name, const std::string& level) {
    ros::NodeHandle handle;
    for (const char* part : {"/set", "/get"}) {
        if (!ros::service::waitForService(node + part, ros::Duration(20))) return 3;
    }
    roscpp::SetLoggerLevel order;
    order.request.logger = name;
    order.request.level = level;
    if (!ros::service::call(node + "/set", order)) return 4;
    auto client = handle.serviceClient<roscpp::GetLoggers>(node + "/get", true);
    for (int i = 0; i < 2; ++i) {
        roscpp::GetLoggers question;
        if (!client.call(question)) return 5;
        for (const auto& logger : question.response.loggers) std::cout << logger.name << " " << logger.level << std::endl;
    }
    order.request.level = "broken";
    if (ros::service::call(node + "/set", order)) return 6;
    std::cout << "refused" << std::endl;
    if (ros::service::call(node + "/nothing", order)) return 7;
    std::cout << "refused" << std::endl;
    return 0;
}

int main(int argc, char** argv) {
    ros::init(argc, argv, "services", ros::init_options::AnonymousName | ros::init_options::NoRosout);
    if (argc == 5 && std::string(argv[1]) == "call") return call(argv[2], argv[3], argv[4]);
    ros::NodeHandle handle;
    auto one = handle.advertiseService("/lamp/set", set);
    auto two = handle.advertiseService("/lamp/get", get);
    ros::spin();
    return 0;
}
